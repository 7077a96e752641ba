"""Control protocol of a running node: requests and responses as lines of JSON.

Sans-I/O. A request is one line of at most ``LINE_MAX_BYTES``, each response is one line::

    --> {"command": "status"}
    <-- {"ok": true, "result": {"state": "running", ...}}
    --> {"command": "drain"}
    <-- {"ok": true, "result": {"state": "draining"}}
    <-- {"ok": true, "result": {"state": "drained", "complete": true}}
    --> {"command": "dance"}
    <-- {"ok": false, "error": "unknown command 'dance'; expected drain, reload, status"}
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from gdp.errors import GdpError, LocalError

__all__ = [
    "LINE_MAX_BYTES",
    "RESPONSE_MAX_BYTES",
    "Command",
    "ControlRequestError",
    "LineBuffer",
    "Response",
    "decode_request",
    "decode_response",
    "encode_request",
    "encode_response",
]

LINE_MAX_BYTES: Final = 4_096  # of a request, its line feed included
RESPONSE_MAX_BYTES: Final = 1 << 18
_QUOTED_CHARS: Final = 40


class ControlRequestError(GdpError):
    """A request or response cannot be parsed; a node responds with the text, and continues."""


class Command(Enum):
    """Command of a client to a node."""

    RELOAD = "reload"
    STATUS = "status"
    DRAIN = "drain"


@dataclass(frozen=True, slots=True)
class Response:
    """Response of a node.

    Args:
        result: JSON fields; empty if ``error`` gives the reason of a refusal.
    """

    result: Mapping[str, object] = field(default_factory=dict)
    error: str = ""

    @property
    def is_ok(self) -> bool:
        """Return whether the node executed the command."""
        return not self.error


class LineBuffer:
    """Buffer that splits received bytes into lines.

    Args:
        max_bytes: largest line, its line feed included.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._rest = b""

    def receive_bytes(self, data: bytes) -> list[bytes]:
        """Return the lines that are now complete, without their line feed.

        Raises:
            ControlRequestError: a line is longer than allowed; the connection is unusable after that.
        """
        *lines, rest = (self._rest + data).split(b"\n")
        if max(map(len, (*lines, rest))) >= self._max_bytes:
            raise ControlRequestError(f"a line has at most {self._max_bytes} bytes")
        self._rest = rest
        return lines


def encode_request(command: Command) -> bytes:
    """Return a request as one line."""
    return json.dumps({"command": command.value}).encode() + b"\n"


def decode_request(line: bytes) -> Command:
    """Return the command of a request.

    Raises:
        ControlRequestError: the line is not a request; the text gives the reason.
    """
    fields = _decode_object(line)
    if set(fields) != {"command"} or not isinstance(fields["command"], str):
        raise ControlRequestError('expected one key, such as {"command": "status"}')
    word = fields["command"]
    try:
        return Command(word)
    except ValueError as error:
        known = ", ".join(sorted(each.value for each in Command))
        raise ControlRequestError(f"unknown command {word[:_QUOTED_CHARS]!r}; expected {known}") from error


def encode_response(response: Response) -> bytes:
    """Return a response as one line. Raises ``LocalError``: the result is larger than a client accepts."""
    fields: dict[str, object] = {"ok": response.is_ok}
    fields |= {"result": dict(response.result)} if response.is_ok else {"error": response.error}
    line = json.dumps(fields).encode() + b"\n"
    if len(line) > RESPONSE_MAX_BYTES:
        raise LocalError(f"the response has {len(line)} bytes; at most {RESPONSE_MAX_BYTES} are sent")
    return line


def decode_response(line: bytes) -> Response:
    """Return the response that a line holds."""
    match _decode_object(line):
        case {"ok": True, "result": dict(result)}:
            return Response(result)
        case {"ok": False, "error": str(error)} if error:
            return Response(error=error)
    raise ControlRequestError("the node sent no response that this version reads")


def _decode_object(line: bytes) -> dict[str, object]:
    try:
        fields = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise ControlRequestError("expected a line of JSON") from error
    if not isinstance(fields, dict):
        raise ControlRequestError("expected a JSON object")
    return fields
