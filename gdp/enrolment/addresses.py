"""Addresses under which the world may reach this machine, and what a person states about them.

I/O; asks the routing table and the resolver, and sends nothing.
"""

from __future__ import annotations

import contextlib
import ipaddress
import re
import socket
from pathlib import Path
from typing import Final

from gdp.control.endpoints import Endpoint
from gdp.errors import LocalError
from gdp.host_port import split_host_port

# Documentation addresses (RFC 5737, RFC 3849): a UDP socket that is connected to them only looks up the route.
_PROBES: Final = ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1"))
_UNITS: Final = {"s": 1, "m": 60, "h": 3_600, "d": 86_400}
_HOST: Final = re.compile(r"[A-Za-z0-9.-]{1,120}", re.ASCII)


def default_addresses() -> list[str]:
    """Return this machine's addresses on its default routes, IPv4 first; empty: there is no default route."""
    found = []
    for family, probe in _PROBES:
        with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as asked:
            asked.connect((probe, 9))
            address = ipaddress.ip_address(str(asked.getsockname()[0]))
            if not address.is_loopback and not address.is_link_local:
                found.append(str(address))
    return found


def is_private(address: str) -> bool:
    """Return whether an address is reachable only inside its own network, so that others need a stated one."""
    return not ipaddress.ip_address(address).is_global


def server_text(text: str, port: int) -> str:
    """Return ``host:port`` of what a person states: a host, an address, or either with a port.

    Raises:
        LocalError: it is neither.
    """
    is_bracketed = text.startswith("[") and text.endswith("]")
    with contextlib.suppress(ValueError):
        return Endpoint(str(ipaddress.ip_address(text[1:-1] if is_bracketed else text)), port).to_text()
    if ":" not in text:
        text = f"{text}:{port}"
    host, _ = split_host_port(text)
    if ":" not in host and not _HOST.fullmatch(host):
        raise LocalError(f"expected a host or an address, with or without a port, not {text!r}")
    return text


def endpoint_of(server: str) -> Endpoint:
    """Return the numeric endpoint of ``host:port``. Raises ``LocalError``: the host has no address."""
    host, port = split_host_port(server)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    except OSError as error:
        raise LocalError(f"{host}: has no address: {error.strerror}") from error
    return Endpoint(str(ipaddress.ip_address(str(found[0][4][0]))), port)


def duration_s(text: str) -> float:
    """Read a duration such as ``90s``, ``30m``, ``1h`` or ``7d``, in seconds. Raises ``LocalError``: another form."""
    number, unit = text[:-1], text[-1:]
    if unit not in _UNITS or not re.fullmatch(r"[0-9]{1,6}", number, re.ASCII) or not int(number):
        raise LocalError(f"expected a duration such as 30m, 1h or 7d, not {text!r}")
    return float(int(number) * _UNITS[unit])


def default_directory(name: str, *, is_root: bool, state_home: str) -> Path:
    """Return the directory of a domain's files on this machine; ``state_home``: ``XDG_STATE_HOME``, or empty."""
    if is_root:
        return Path("/var/lib/gdp") / name
    return (Path(state_home) if state_home else Path.home() / ".local/state") / "gdp" / name
