"""Client of control sockets: finds the socket of a node and sends it a command.

I/O. The socket of a node is named after the node's identity and lies in the lock directory (``single_instance``). The
directory of the node's keys is therefore enough to find it.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.names import Name
from gdp.nodes.control_protocol import (
    RESPONSE_MAX_BYTES,
    Command,
    LineBuffer,
    Response,
    decode_response,
    encode_request,
)
from gdp.nodes.control_socket import CONTROL_SOCKET, connect_control
from gdp.nodes.single_instance import lock_directories, lock_directory
from gdp.stores.keyring import CARD, load_card

__all__ = [
    "NotRunningError",
    "ask_node",
    "control_path",
    "find_control_socket",
    "find_control_socket_of",
    "request_control",
]

_RECEIVE_BYTES: Final = 1 << 16
_ABSENT: Final = (errno.ENOENT, errno.ECONNREFUSED, errno.ENOTDIR)


class NotRunningError(LocalError):
    """No process serves the control socket."""


def control_path(name: Name) -> Path:
    """Return the control socket of a node that runs as this user."""
    return lock_directory() / f"{name.to_text()}.sock"


def find_control_socket(directory: Path) -> Path:
    """Return the control socket of the node whose keys, or whose state, are in a directory.

    Raises:
        LocalError: the directory belongs to no node.
    """
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


def request_control(path: Path, command: Command, timeout_s: float) -> Iterator[Response]:
    """Send a command to a control socket and yield each response.

    Args:
        timeout_s: seconds to wait for each response.

    Raises:
        NotRunningError: no process serves the socket.
        LocalError: the user may not reach it, or no response comes in time.
        ControlRequestError: the response cannot be read.
    """
    try:
        with connect_control(path, timeout_s) as connection:
            connection.sendall(encode_request(command))
            lines = LineBuffer(RESPONSE_MAX_BYTES + 1)
            while data := connection.recv(_RECEIVE_BYTES):
                for line in lines.receive_bytes(data):
                    yield decode_response(line)
    except TimeoutError as error:
        raise LocalError(f"{path}: no response within {timeout_s:g} s") from error
    except OSError as error:
        if error.errno in _ABSENT:
            raise NotRunningError(f"{path}: no process serves this control socket; start the node first") from error
        raise LocalError(f"{path}: {error.strerror}; run the command as the user of the node") from error


def ask_node(path: Path, command: Command, timeout_s: float) -> Response:
    """Send a command and return the first response.

    Raises:
        GdpError: as for ``request_control``, or the node ended before it responded.
    """
    for response in request_control(path, command, timeout_s):
        return response
    raise LocalError(f"{path}: the node closed the connection before it answered")
