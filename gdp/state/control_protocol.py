"""Control protocol of a running node: requests and responses as lines of JSON.

Sans-I/O. A request is one line of at most ``LINE_MAX_BYTES``, each response is one line::

    --> {"command": "status"}
    <-- {"ok": true, "result": {"state": "running", ...}}
    --> {"command": "drain"}
    <-- {"ok": true, "result": {"state": "draining"}}
    <-- {"ok": true, "result": {"state": "drained", "complete": true}}
    --> {"command": "show", "what": "neighbors", "from": 0}
    <-- {"ok": true, "result": {"rows": [...], "next": null}}
    --> {"command": "ask", "id": 7, "ask": "ping", "target": "75e0...", "timeout_s": 0.5}
    <-- {"ok": true, "result": {"id": 7, "state": "answered", "rtt_ms": 0.8, ...}}
    --> {"command": "dance"}
    <-- {"ok": false, "error": "unknown command 'dance'; expected ask, drain, incident, lookup, ..."}

A lookup names a 256-bit name as well: ``{"command": "lookup", "name": "75e1..."}``. The response to ``ask`` comes when
the reply has come, so that responses may overtake each other.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from gdp.errors import GdpError, LocalError
from gdp.names import Name

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
    TOPICS = "topics"
    LOOKUP = "lookup"
    ASK = "ask"  # send a diagnostic request as the member that the node is
    SHOW = "show"  # one page of a table
    INCIDENT = "incident"  # one page of the journal
    SNAPSHOT = "snapshot"  # see ``snapshot``: what a live view shows
    TOPOLOGY = "topology"


_WITH_ARGUMENTS: Final = (Command.ASK, Command.INCIDENT, Command.LOOKUP, Command.SHOW)


@dataclass(frozen=True, slots=True)
class Request:
    """Request of a client; ``arguments``: JSON fields; only ``ask``, ``incident``, ``lookup`` and ``show`` have any."""

    command: Command
    arguments: Mapping[str, object] = field(default_factory=dict)

    @property
    def name(self) -> Name | None:
        """Return the name of a lookup."""
        name = self.arguments.get("name")
        return Name.from_text(name) if self.command is Command.LOOKUP and isinstance(name, str) else None


@dataclass(frozen=True, slots=True)
class Response:
    """Response of a node; ``result``: JSON fields; empty if ``error`` gives the reason of a refusal."""

    result: Mapping[str, object] = field(default_factory=dict)
    error: str = ""

    @property
    def is_ok(self) -> bool:
        """Return whether the node executed the command."""
        return not self.error


Respond = Callable[[Response], None]


class LineBuffer:
    """Buffer that splits received bytes into lines; ``max_bytes``: largest line, its line feed included."""

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


def encode_request(request: Request) -> bytes:
    """Return a request as one line. Raises ``LocalError``: it is larger than a node accepts."""
    line = json.dumps({"command": request.command.value, **request.arguments}).encode() + b"\n"
    if len(line) > LINE_MAX_BYTES:
        raise LocalError(f"the request has {len(line)} bytes; at most {LINE_MAX_BYTES} are accepted")
    return line


def decode_request(line: bytes) -> Request:
    """Return the request that a line holds.

    Raises:
        ControlRequestError: the line is not a request; the text gives the reason.
    """
    fields = _decode_object(line)
    word = fields.pop("command", None)
    if not isinstance(word, str):
        raise ControlRequestError('expected a command, such as {"command": "status"}')
    try:
        command = Command(word)
    except ValueError as error:
        known = ", ".join(sorted(each.value for each in Command))
        raise ControlRequestError(f"unknown command {word[:_QUOTED_CHARS]!r}; expected {known}") from error
    if fields and command not in _WITH_ARGUMENTS:
        raise ControlRequestError(f'expected no other key: {{"command": "{word}"}}')
    request = Request(command, fields)
    if command is Command.LOOKUP:
        _check_lookup(request)
    return request


def _check_lookup(request: Request) -> None:
    try:
        is_right = set(request.arguments) == {"name"} and request.name is not None
    except LocalError as error:
        raise ControlRequestError(f"name: expected 64 hex digits: {error}") from error
    if not is_right:
        raise ControlRequestError('expected a command and a name: {"command": "lookup", "name": "75e1..."}')


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
