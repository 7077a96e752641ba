"""Checks before a machine creates or joins a domain: what its programs need is there, so nothing is left half made.

I/O; makes a tunnel device for a moment, and binds the ports for a moment.
"""

from __future__ import annotations

import contextlib
import errno
import secrets
import socket
from collections.abc import Iterator, Mapping
from typing import Final

from gdp.errors import LocalError
from gdp.ports.sockets import AS_ROOT
from gdp.ports.tcp_server import listen_tcp
from gdp.ports.tunnel.keeper_process import KeeperProcess

_ALIAS: Final = "gdp preflight"
_TAKEN: Final = "is in use by another program (ss -lntup shows it); end that one, or state another port with"


def check_tunnels() -> None:
    """Return if this machine can make tunnel devices. Raises ``LocalError``: it cannot; the text says what to do."""
    ifname = f"gc0-{secrets.token_hex(4)}"
    try:
        keeper = KeeperProcess(ifname, _ALIAS, "auto")
    except LocalError as error:
        text = str(error).removeprefix(f"tunnel {ifname}: ")
        raise LocalError(f"this machine cannot make tunnels: {text}") from error
    keeper.close()


def check_ports(udp: Mapping[int, str], tcp: Mapping[int, str]) -> None:
    """Return if these ports are free.

    Args:
        udp, tcp: numbers, each with the option that states it.

    Raises:
        LocalError: one is taken, or needs a right.
    """
    for port, option in tcp.items():
        with _explained("TCP", port, option):
            listen_tcp("", port).close()
    for port, option in udp.items():
        with _explained("UDP", port, option), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
            bound.bind(("", port))


@contextlib.contextmanager
def _explained(protocol: str, port: int, option: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise LocalError(f"{protocol} port {port} {_TAKEN} {option}") from error
        if error.errno in (errno.EACCES, errno.EPERM):
            raise LocalError(f"{protocol} port {port} needs a right of root; {AS_ROOT}") from error
        raise LocalError(f"{protocol} port {port} cannot be bound: {error.strerror or error}") from error
