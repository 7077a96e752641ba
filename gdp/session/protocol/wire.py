"""Wire forms of the library inside sealed messages.

Sans-I/O. All big-endian::

    message    version (1) | stamp in ns since 1970 (8)                              | payload
    request    version (1) | kind 0 (1) | call (8) | patience in ms, 0: none (4)     | payload
    response   version (1) | kind 1 (1) | call (8) | outcome (1)                     | payload, or a reason in UTF-8
    stop       version (1) | kind 2 (1) | calls that have ended (8 each)
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from gdp.errors import DropReason, RemoteError
from gdp.limits import MESSAGE_MAX_BYTES
from gdp.service.dispatch import STOP_MAX

__all__ = [
    "LEAVING",
    "PATIENCE_MAX_MS",
    "PAYLOAD_MAX_BYTES",
    "SERVING",
    "RequestFrame",
    "ResponseFrame",
    "StopFrame",
    "message_to_wire",
    "read_message",
    "read_request",
    "read_response",
]

VERSION: Final = 1
SERVING: Final = b"gdp-session-1"  # description of a server, and of a client
LEAVING: Final = b"gdp-session-1 leaving"  # ... of a server that finishes its active requests, and accepts no more
PATIENCE_MAX_MS: Final = (1 << 32) - 1
_REASON_MAX_BYTES: Final = 1_024
_KIND_REQUEST, _KIND_RESPONSE, _KIND_STOP = range(3)
_MESSAGE: Final = struct.Struct("!BQ")
_REQUEST: Final = struct.Struct("!BBQI")
_RESPONSE: Final = struct.Struct("!BBQB")
_STOP: Final = struct.Struct("!BB")
_CALL: Final = struct.Struct("!Q")
PAYLOAD_MAX_BYTES: Final = MESSAGE_MAX_BYTES - _REQUEST.size


class RequestFrame(NamedTuple):
    """A request under its client's number."""

    call: int
    patience_ms: int  # 0: the client waits without a limit
    payload: bytes

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return _REQUEST.pack(VERSION, _KIND_REQUEST, self.call, self.patience_ms) + self.payload


class ResponseFrame(NamedTuple):
    """Response of a server to one request: a payload, or the reason for its failure."""

    call: int
    is_failure: bool
    payload: bytes

    @classmethod
    def failed(cls, call: int, reason: str) -> ResponseFrame:
        """Return the response to a request that cannot be served."""
        return cls(call, True, reason.encode()[:_REASON_MAX_BYTES])

    @property
    def reason(self) -> str:
        """Return why a request failed."""
        return self.payload[:_REASON_MAX_BYTES].decode("utf-8", "replace")

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return _RESPONSE.pack(VERSION, _KIND_RESPONSE, self.call, self.is_failure) + self.payload


class StopFrame(NamedTuple):
    """Calls of a client that have ended; a server that has not begun them drops them."""

    calls: Sequence[int]

    def to_wire(self) -> bytes:
        """Return the wire form."""
        return _STOP.pack(VERSION, _KIND_STOP) + b"".join(map(_CALL.pack, self.calls))


def message_to_wire(stamp_ns: int, payload: bytes) -> bytes:
    """Return the wire form of a published message."""
    return _MESSAGE.pack(VERSION, stamp_ns) + payload


def read_message(wire: bytes) -> tuple[int, bytes]:
    """Return stamp (ns since 1970) and payload of a published message.

    Raises:
        RemoteError: MALFORMED or BAD_VERSION.
    """
    if len(wire) < _MESSAGE.size:
        raise RemoteError(DropReason.MALFORMED, "a message that is too short")
    version, stamp_ns = _MESSAGE.unpack_from(wire)
    if version != VERSION:
        raise RemoteError(DropReason.BAD_VERSION, f"message version {version}")
    return stamp_ns, wire[_MESSAGE.size :]


def read_request(wire: bytes) -> RequestFrame | StopFrame:
    """Parse a frame of a client.

    Raises:
        RemoteError: MALFORMED or BAD_VERSION.
    """
    kind = _kind_of(wire)
    if kind == _KIND_REQUEST and len(wire) >= _REQUEST.size:
        _, _, call, patience_ms = _REQUEST.unpack_from(wire)
        return RequestFrame(call, patience_ms, wire[_REQUEST.size :])
    calls = wire[_STOP.size :]
    if kind != _KIND_STOP or not calls or len(calls) % _CALL.size or len(calls) > STOP_MAX * _CALL.size:
        raise RemoteError(DropReason.MALFORMED, "neither a request nor a stop")
    return StopFrame([call for (call,) in _CALL.iter_unpack(calls)])


def read_response(wire: bytes) -> ResponseFrame:
    """Parse a frame of a server to one client.

    Raises:
        RemoteError: MALFORMED or BAD_VERSION.
    """
    if _kind_of(wire) != _KIND_RESPONSE or len(wire) < _RESPONSE.size:
        raise RemoteError(DropReason.MALFORMED, "not a response")
    _, _, call, outcome = _RESPONSE.unpack_from(wire)
    if outcome > 1:
        raise RemoteError(DropReason.MALFORMED, "a response of an unknown outcome")
    return ResponseFrame(call, bool(outcome), wire[_RESPONSE.size :])


def _kind_of(wire: bytes) -> int:
    if len(wire) < _STOP.size:
        raise RemoteError(DropReason.MALFORMED, "a call that is too short")
    if wire[0] != VERSION:
        raise RemoteError(DropReason.BAD_VERSION, f"call version {wire[0]}")
    return wire[1]
