"""Wire forms of the library inside sealed messages.

Sans-I/O. Calls are in ``gdp/service/frames.py``, with part 0 (requests), 1 (responses) and tag 2 (stops); further,
big-endian::

    message    version (1) | stamp in ns since 1970 (8)                              | payload
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Final

from gdp.errors import DropReason, RemoteError
from gdp.limits import MESSAGE_MAX_BYTES
from gdp.service.frames import HEAD_MAX_BYTES, VERSION, Answer, Request, calls_to_wire, read_calls

SERVING: Final = b"gdp-session-1"  # description of a server, and of a client
LEAVING: Final = b"gdp-session-1 leaving"  # ... of a server that finishes its active requests, and accepts no more
REQUEST, RESPONSE, _STOP = range(3)
_MESSAGE: Final = struct.Struct("!BQ")
PAYLOAD_MAX_BYTES: Final = MESSAGE_MAX_BYTES - HEAD_MAX_BYTES


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


def stop_to_wire(calls: Iterable[int]) -> bytes:
    """Return a client's notice that calls have ended; a server that has not begun them drops them."""
    return calls_to_wire(_STOP, calls)


def read_request(wire: bytes) -> Request | Sequence[int]:
    """Return a client's request, or its calls that have ended. Raises ``RemoteError``: MALFORMED or BAD_VERSION."""
    if wire[1:2] == bytes([_STOP]):
        return read_calls(wire)[1]
    request = Request.from_wire(wire)
    if request.part != REQUEST:
        raise RemoteError(DropReason.MALFORMED, "neither a request nor a stop")
    return request


def read_response(wire: bytes) -> Answer:
    """Return a server's response to one client. Raises ``RemoteError``: MALFORMED or BAD_VERSION."""
    response = Answer.from_wire(wire)
    if response.part != RESPONSE:
        raise RemoteError(DropReason.MALFORMED, "not a response")
    return response
