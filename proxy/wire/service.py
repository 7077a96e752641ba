"""Service protocol: wire forms of the calls of a service or an action inside sealed messages, and its description.

Sans-I/O. Every reader raises ``RemoteError`` (MALFORMED or BAD_VERSION) for any invalid bytes.

A service has one part, itself. An action has five, in this order: the services ``send_goal``, ``cancel_goal``
and ``get_result``, and the topics ``feedback`` and ``status``. Wire forms, big-endian::

    request   version (1) | part (1) | call (8) | patience in ms, 0: none (4) | body
    answer    version (1) | part (1) | call (8) | outcome (1)                 | body, or a reason in UTF-8
    news      version (1) | part (1) | stamp in ns (8)                        | body
    stop      version (1) | part + 0x80 (1) | calls that have ended (8 each)
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Final, NamedTuple

from gdp.crypto.schema import FLAG, FieldSet, Keyed, many
from gdp.errors import DropReason, RemoteError, StatementError
from gdp.limits import MESSAGE_MAX_BYTES
from gdp.service.dispatch import STOP_MAX
from proxy.serial.channel import CHANNEL, CHANNEL_MAX_BYTES, Channel
from proxy.serial.serializer import ENCODING, Encoding
from proxy.serial.service import SERVICE, Service

__all__ = ["Answer", "Exchange", "News", "Outcome", "Request", "Stop", "too_large"]

VERSION: Final = 1
PARTS_MAX: Final = 8
_STOPS: Final = 0x80  # in the position of a part
PATIENCE_MAX_MS: Final = (1 << 32) - 1
_REASON_MAX_BYTES: Final = 1_024
_REQUEST: Final = struct.Struct("!BBQI")
_ANSWER: Final = struct.Struct("!BBQB")
_NEWS: Final = struct.Struct("!BBQ")
_STOP: Final = struct.Struct("!BB")
_CALL: Final = struct.Struct("!Q")
_HEAD_MAX_BYTES: Final = max(_REQUEST.size, _ANSWER.size, _NEWS.size)


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
        part, call, patience_ms = _head(_REQUEST, wire)
        return cls(part, call, patience_ms, wire[_REQUEST.size :])


class Stop(NamedTuple):
    """Cancellation from a client's proxy: calls that have ended, on which servers need not work any more."""

    part: int
    calls: tuple[int, ...]

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return _STOP.pack(VERSION, self.part | _STOPS) + b"".join(map(_CALL.pack, self.calls))

    @staticmethod
    def is_in(wire: bytes) -> bool:
        """Return whether these bytes are a cancellation, not a request."""
        return len(wire) >= _STOP.size and bool(wire[1] & _STOPS)

    @classmethod
    def from_wire(cls, wire: bytes) -> Stop:
        """Read the wire form."""
        (part,) = _head(_STOP, wire)
        calls = wire[_STOP.size :]
        if not part & _STOPS or not calls or len(calls) % _CALL.size:
            raise RemoteError(DropReason.MALFORMED, "a word about ended calls that names none")
        if len(calls) > STOP_MAX * _CALL.size:
            raise RemoteError(DropReason.MALFORMED, f"a word about more than {STOP_MAX} ended calls")
        return cls(part & ~_STOPS, tuple(call for (call,) in _CALL.iter_unpack(calls)))


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
        part, call, outcome = _head(_ANSWER, wire)
        if outcome not in Outcome.__members__.values():
            raise RemoteError(DropReason.MALFORMED, "an answer that says neither yes nor no")
        return cls(part, call, Outcome(outcome), wire[_ANSWER.size :])


class News(NamedTuple):
    """A message of an action's topics, from its server to all clients."""

    part: int
    stamp_ns: int
    body: bytes

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return _NEWS.pack(VERSION, self.part, self.stamp_ns) + self.body

    @classmethod
    def from_wire(cls, wire: bytes) -> News:
        """Read the wire form."""
        part, stamp_ns = _head(_NEWS, wire)
        return cls(part, stamp_ns, wire[_NEWS.size :])


def too_large(what: str, raw_bytes: int, max_bytes: int, body_bytes: int) -> str:
    """Return why a message cannot be sent: above its rule's limit, or encoded above the general one; else empty."""
    if raw_bytes > max_bytes:
        return f"{what} of {raw_bytes} bytes; the rule's max_bytes is {max_bytes}"
    if body_bytes > MESSAGE_MAX_BYTES - _HEAD_MAX_BYTES:
        return f"{what} of {body_bytes} bytes as it travels; at most {MESSAGE_MAX_BYTES - _HEAD_MAX_BYTES} can"
    return ""


def _head(form: struct.Struct, wire: bytes) -> tuple[int, ...]:
    if len(wire) < form.size:
        raise RemoteError(DropReason.MALFORMED, "a call that is too short")
    version, *rest = form.unpack_from(wire)
    if version != VERSION:
        raise RemoteError(DropReason.BAD_VERSION, f"call version {version}")
    return tuple(rest)


@dataclass(frozen=True, slots=True)
class Exchange(FieldSet):
    """Description of a service or an action by one side, with its encoding.

    Args:
        topics: of an action; their parts follow the services'.
        is_leaving: the server answers what is under way, and then leaves; clients use others.
        is_ordered: it keeps state, and executes requests in one order only.
    """

    MAX_BYTES = 2 * PARTS_MAX * CHANNEL_MAX_BYTES
    encoding: Annotated[Encoding, Keyed("e", ENCODING)]
    services: Annotated[tuple[Service, ...], Keyed("s", many(SERVICE, PARTS_MAX, is_cut=False))]
    topics: Annotated[tuple[Channel, ...], Keyed("c", many(CHANNEL, PARTS_MAX, is_cut=False))] = ()
    is_leaving: Annotated[bool, Keyed("l", FLAG, absent=False, is_omitted=True)] = False
    is_ordered: Annotated[bool, Keyed("o", FLAG, absent=False, is_omitted=True)] = False

    def check(self) -> None:
        """Return if there is a service, and not too many parts. Raises ``StatementError``: MALFORMED."""
        if not self.services or len(self.services) + len(self.topics) > PARTS_MAX:
            raise StatementError(DropReason.MALFORMED, "a description of a service")
