"""Frames of calls inside sealed messages, of the library's services and of proxies.

Sans-I/O. Every ``from_wire`` raises ``RemoteError`` (MALFORMED or BAD_VERSION) for any invalid bytes. Wire forms,
big-endian::

    request   version (1) | part (1) | call (8) | patience in ms, 0: none (4) | body
    answer    version (1) | part (1) | call (8) | outcome (1)                 | body, or a reason in UTF-8
    stop      version (1) | tag (1)  | calls that have ended (8 each)

A proxy's part is that of an action, and the tag of a stop is ``part + 0x80``; the library has fixed ones.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from enum import IntEnum
from typing import Final, NamedTuple

from gdp.errors import DropReason, RemoteError
from gdp.service.dispatch import STOP_MAX

VERSION: Final = 1
PATIENCE_MAX_MS: Final = (1 << 32) - 1
_STOPS: Final = 0x80  # in the position of a part
_REASON_MAX_BYTES: Final = 1_024
_REQUEST: Final = struct.Struct("!BBQI")
_ANSWER: Final = struct.Struct("!BBQB")
_STOP: Final = struct.Struct("!BB")
_CALL: Final = struct.Struct("!Q")
HEAD_MAX_BYTES: Final = max(_REQUEST.size, _ANSWER.size)


class Outcome(IntEnum):
    """Outcome of a call."""

    ANSWERED = 0
    FAILED = 1  # at the server's side; the body is the reason


class Request(NamedTuple):
    """A call, from a client's proxy to a server's."""

    part: int
    call: int
    patience_ms: int
    body: bytes

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return _REQUEST.pack(VERSION, self.part, self.call, self.patience_ms) + self.body

    @classmethod
    def from_wire(cls, wire: bytes) -> Request:
        """Read the wire form."""
        part, call, patience_ms = read_head(_REQUEST, wire)
        return cls(part, call, patience_ms, wire[_REQUEST.size :])


class Stop(NamedTuple):
    """Cancellation from a client's proxy: calls that have ended, on which servers need not work any more."""

    part: int
    calls: tuple[int, ...]

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return calls_to_wire(self.part | _STOPS, self.calls)

    @staticmethod
    def is_in(wire: bytes) -> bool:
        """Return whether these bytes are a cancellation, not a request."""
        return len(wire) >= _STOP.size and bool(wire[1] & _STOPS)

    @classmethod
    def from_wire(cls, wire: bytes) -> Stop:
        """Read the wire form."""
        tag, calls = read_calls(wire)
        if not tag & _STOPS:
            raise RemoteError(DropReason.MALFORMED, "no word about ended calls")
        return cls(tag & ~_STOPS, calls)


class Answer(NamedTuple):
    """Result of a call, for the one client that made it."""

    part: int
    call: int
    outcome: Outcome
    body: bytes

    @classmethod
    def failed(cls, part: int, call: int, reason: str) -> Answer:
        """Return the answer to a call that could not be served."""
        return cls(part, call, Outcome.FAILED, reason.encode()[:_REASON_MAX_BYTES])

    @property
    def reason(self) -> str:
        """Return the reason of a failed call."""
        return self.body[:_REASON_MAX_BYTES].decode("utf-8", "replace")

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return _ANSWER.pack(VERSION, self.part, self.call, self.outcome) + self.body

    @classmethod
    def from_wire(cls, wire: bytes) -> Answer:
        """Read the wire form."""
        part, call, outcome = read_head(_ANSWER, wire)
        if outcome not in Outcome.__members__.values():
            raise RemoteError(DropReason.MALFORMED, "an answer that says neither yes nor no")
        return cls(part, call, Outcome(outcome), wire[_ANSWER.size :])


def calls_to_wire(tag: int, calls: Iterable[int]) -> bytes:
    """Return a notice that calls have ended."""
    return _STOP.pack(VERSION, tag) + b"".join(map(_CALL.pack, calls))


def read_calls(wire: bytes) -> tuple[int, tuple[int, ...]]:
    """Return the tag of a notice that calls have ended, and the calls."""
    (tag,) = read_head(_STOP, wire)
    calls = wire[_STOP.size :]
    if not calls or len(calls) % _CALL.size:
        raise RemoteError(DropReason.MALFORMED, "a word about ended calls that names none")
    if len(calls) > STOP_MAX * _CALL.size:
        raise RemoteError(DropReason.MALFORMED, f"a word about more than {STOP_MAX} ended calls")
    return tag, tuple(call for (call,) in _CALL.iter_unpack(calls))


def read_head(form: struct.Struct, wire: bytes) -> tuple[int, ...]:
    """Return the numbers after the version."""
    if len(wire) < form.size:
        raise RemoteError(DropReason.MALFORMED, "a call that is too short")
    version, *rest = form.unpack_from(wire)
    if version != VERSION:
        raise RemoteError(DropReason.BAD_VERSION, f"call version {version}")
    return tuple(rest)
