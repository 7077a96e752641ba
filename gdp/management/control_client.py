"""Client of control sockets: finds the socket of a node and sends it a command.

I/O. The socket of a node is named after the node's identity and lies in the lock directory (``single_instance``). The
directory of the node's keys is therefore enough to find it.
"""

from __future__ import annotations

import base64
import errno
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from gdp.closing import ClosedOnExit
from gdp.crypto.cbor import decode
from gdp.errors import LocalError
from gdp.host.single_instance import lock_directories, lock_directory
from gdp.management.control_socket import CONTROL_SOCKET, connect_control
from gdp.names import Name
from gdp.state.control_protocol import (
    RESPONSE_MAX_BYTES,
    Command,
    ControlRequestError,
    LineBuffer,
    Request,
    Response,
    decode_response,
    encode_request,
)

_RECEIVE_BYTES: Final = 1 << 16
_ABSENT: Final = (errno.ENOENT, errno.ECONNREFUSED, errno.ENOTDIR)


class NotRunningError(LocalError):
    """No process serves the control socket."""


class NodeEndedError(LocalError):
    """The node closed the connection before it answered."""

    def __init__(self, path: Path) -> None:
        super().__init__(f"{path}: the node closed the connection before it answered")


def control_path(name: Name) -> Path:
    """Return the control socket of a node that runs as this user."""
    return lock_directory() / f"{name.to_text()}.sock"


def find_control_socket(directory: Path) -> Path:
    """Return the control socket of the node whose keys, or whose state, are in a directory.

    Raises:
        LocalError: the directory belongs to no node.
    """
    from gdp.stores.keyring import CARD, load_card  # it loads what reads keys; a path of a socket needs none of it

    own = directory / CONTROL_SOCKET
    if own.exists():
        return own
    if not (directory / CARD).exists():
        raise LocalError(f"{directory}: expected the directory of a node, with {CARD} or {CONTROL_SOCKET} in it")
    return find_control_socket_of(load_card(directory / CARD).name)


def find_control_socket_of(name: Name) -> Path:
    """Return the control socket of a node on this host that this user or root runs."""
    own = control_path(name)
    return next((each / own.name for each in lock_directories() if (each / own.name).exists()), own)


def control_sockets() -> list[Path]:
    """Return the control sockets of the nodes of this host that this user or root runs, where they have the usual name.

    Some may be remains of dead processes.
    """
    return sorted(path for folder in lock_directories() for path in folder.glob("*.sock"))


def request_control(path: Path, command: Command, timeout_s: float, name: Name | None = None) -> Iterator[Response]:
    """Send a command to a control socket and yield each response.

    Args:
        timeout_s: seconds to wait for each response.
        name: of a lookup.

    Raises:
        NotRunningError: no process serves the socket.
        LocalError: the user may not reach it, or no response comes in time.
        ControlRequestError: the response cannot be read.
    """
    with NodeConnection(path, timeout_s) as connection:
        connection.send_request(Request(command, {} if name is None else {"name": name.to_text()}))
        yield from connection.responses()


def _translated(error: OSError, path: Path, timeout_s: float) -> LocalError:
    """Return the error to raise where a control socket cannot be used."""
    if isinstance(error, TimeoutError):
        return LocalError(f"{path}: no response within {timeout_s:g} s")
    if isinstance(error, BrokenPipeError | ConnectionResetError):
        return NodeEndedError(path)
    if error.errno in _ABSENT:
        return NotRunningError(f"{path}: no process serves this control socket; start the node first")
    return LocalError(f"{path}: {error.strerror}; run the command as the user of the node")


def ask_node(path: Path, command: Command, timeout_s: float, name: Name | None = None) -> Response:
    """Send a command and return the first response.

    Raises:
        GdpError: as for ``request_control``, or the node ended before it responded.
    """
    for response in request_control(path, command, timeout_s, name):
        return response
    raise NodeEndedError(path)


class NodeConnection(ClosedOnExit):
    """Connection to a node's control socket, for many requests.

    Args:
        timeout_s: seconds to wait for a response, beyond the time that a request itself gives the network.

    Raises:
        NotRunningError: no process serves the socket.
        LocalError: the user may not reach it.
    """

    def __init__(self, path: Path, timeout_s: float = 5.0) -> None:
        self._path = path
        self._timeout_s = timeout_s
        self._lines = LineBuffer(RESPONSE_MAX_BYTES + 1)
        self._received: deque[Response] = deque()
        self._last_id = 0
        try:
            self._socket = connect_control(path, timeout_s)
        except OSError as error:
            raise _translated(error, path, timeout_s) from error

    def fileno(self) -> int:
        """Return a descriptor that is readable when a response may have come."""
        return self._socket.fileno()

    @property
    def has_received(self) -> bool:
        """Return whether a response is here already, which the descriptor does not show."""
        return bool(self._received)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def send_ask(self, ask: str, **arguments: object) -> int:
        """Send a diagnostic request; return its id, which the response repeats.

        Args:
            arguments: ``target`` and ``name`` (hex), ``body``, ``hops``, ``timeout_s``, ``reply_bytes``.
        """
        self._last_id += 1
        self.send_request(Request(Command.ASK, {"id": self._last_id, "ask": ask, **arguments}))
        return self._last_id

    def ask(self, ask: str, **arguments: object) -> Mapping[str, object]:
        """Send a diagnostic request and return its response."""
        return self.ask_all([(ask, arguments)])[0]

    def ask_all(self, requests: Sequence[tuple[str, Mapping[str, object]]]) -> list[Mapping[str, object]]:
        """Send requests at once and return their responses in the same order.

        Raises:
            LocalError: the node refused one; no response came.
        """
        ids = [self.send_ask(ask, **arguments) for ask, arguments in requests]
        found: dict[object, Mapping[str, object]] = {}
        while len(found) < len(ids):
            result = self.read_result()
            found[result.get("id")] = result
        return [found[each] for each in ids]

    def status(self) -> Mapping[str, object]:
        """Return the status of the node."""
        self.send_request(Request(Command.STATUS))
        return self.read_result()

    def show(self, what: str) -> list[Mapping[str, object]]:
        """Return all rows of a table. Raises ``LocalError``: the node has no such table."""
        rows: list[Mapping[str, object]] = []
        at: object = 0
        while at is not None:
            self.send_request(Request(Command.SHOW, {"what": what, "from": at}))
            page = self.read_result()
            some, at = page.get("rows"), page.get("next")
            if not isinstance(some, list) or not all(isinstance(row, dict) for row in some):
                raise ControlRequestError(f"{self._path}: the node sent no table that this version reads")
            rows += some
        return rows

    def journal(self) -> tuple[Any, list[bytes]]:
        """Return head and blocks of the node's journal.

        Raises:
            LocalError: the node keeps none, or writes it faster than this reads.
        """
        blocks: list[bytes] = []
        head: Any = None
        asked: dict[str, object] = {}
        while head is None or asked["from"] != asked["until"]:
            self.send_request(Request(Command.INCIDENT, asked))
            page: Any = self.read_result()
            head = head or decode(base64.b64decode(page["head"]))
            blocks += map(base64.b64decode, page["blocks"])
            asked = {"from": page["next"], "until": page["until"]}
        return head, blocks

    def read_result(self) -> Mapping[str, object]:
        """Return the next response's result. Raises ``LocalError``: the node refused a request, ended or is silent."""
        response = next(self.responses(), None)
        if response is None:
            raise NodeEndedError(self._path)
        if not response.is_ok:
            raise LocalError(f"{self._path}: {response.error}")
        return response.result

    def responses(self) -> Iterator[Response]:
        """Yield each response until the node ends; errors as for ``read_result``."""
        while True:
            while not self._received:
                try:
                    data = self._socket.recv(_RECEIVE_BYTES)
                except OSError as error:
                    raise _translated(error, self._path, self._timeout_s) from error
                if not data:
                    return
                self._received += map(decode_response, self._lines.receive_bytes(data))
            yield self._received.popleft()

    def send_request(self, request: Request) -> None:
        """Send a request, whose responses ``responses`` yields."""
        try:
            self._socket.settimeout(self._timeout_s)
            self._socket.sendall(encode_request(request))
        except OSError as error:
            raise _translated(error, self._path, self._timeout_s) from error
