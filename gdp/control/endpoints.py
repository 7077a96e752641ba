"""Endpoints of tunnels: where a node can be reached across IP networks, and what follows from its name alone.

Sans-I/O. A tunnel is VXLAN (RFC 7348) inside WireGuard. Its inner IPv6 address is a unique local one (RFC 4193) that
follows from the node's name, so it needs no configuration, and two nodes never share it by mistake.
"""

from __future__ import annotations

import hashlib
import ipaddress
from typing import Final, NamedTuple

from gdp.errors import LocalError
from gdp.names import Name

_PORT_MAX: Final = 65_535
_ULA: Final = b"\xfd"  # RFC 4193, section 3.1, locally assigned
_ADDRESS_BYTES: Final = 16
_PORT_BYTES: Final = 2
ENDPOINT_MAX_BYTES: Final = _ADDRESS_BYTES + _PORT_BYTES
_VNI_BYTES: Final = 3
_PRIVATE: Final = tuple(  # RFC 1918, RFC 6598
    ipaddress.ip_network(each) for each in ("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "100.64.0.0/10")
)


class Endpoint(NamedTuple):
    """A UDP or TCP endpoint.

    Attributes:
        address: numeric, IPv4 or IPv6, in the form of ``ipaddress``.
        port: 1 to 65,535.
    """

    address: str
    port: int

    @classmethod
    def from_text(cls, text: str) -> Endpoint:
        """Read ``192.0.2.1:51820`` or ``[2001:db8::1]:51820``. Raises ``LocalError``: not of this form."""
        host, colon, port = text.rpartition(":")
        is_bracketed = host.startswith("[") and host.endswith("]")
        try:
            address = ipaddress.ip_address(host[1:-1] if is_bracketed else host)
            number = int(port) if port.isascii() and port.isdecimal() else 0
        except ValueError as error:
            raise LocalError(f"expected address:port, not {text!r}") from error
        if not colon or is_bracketed is not (address.version == 6) or not 0 < number <= _PORT_MAX:
            raise LocalError(f"expected address:port, not {text!r}")
        return cls(str(address), number)

    def to_text(self) -> str:
        """Return the form that ``from_text`` reads."""
        return f"[{self.address}]:{self.port}" if ":" in self.address else f"{self.address}:{self.port}"

    @classmethod
    def from_wire(cls, wire: bytes) -> Endpoint:
        """Read 6 bytes (IPv4) or 18 (IPv6), the port last. Raises ``ValueError``: not of this form."""
        port = int.from_bytes(wire[-_PORT_BYTES:], "big")
        address = ipaddress.ip_address(wire[:-_PORT_BYTES])
        if not port:
            raise ValueError("port 0")
        return cls(str(address), port)

    @property
    def is_private(self) -> bool:
        """Whether the address is of private IPv4 networks, so that it has a meaning in its own network only."""
        address = ipaddress.ip_address(self.address)
        return any(address in each for each in _PRIVATE)

    def to_wire(self) -> bytes:
        """Return the bytes that ``from_wire`` reads."""
        return ipaddress.ip_address(self.address).packed + self.port.to_bytes(_PORT_BYTES, "big")


def inner_address(name: Name, uplink: int = 0) -> str:
    """Return the node's IPv6 address inside its tunnels; each of several uplinks has its own."""
    digest = hashlib.sha256(b"gdp-tunnel-address-1" + bytes([uplink]) + name).digest()
    return str(ipaddress.IPv6Address(_ULA + digest[: _ADDRESS_BYTES - len(_ULA)]))


def tunnel_vni(one: str, other: str) -> int:
    """Return the VXLAN network identifier of a tunnel between two inner addresses, the same at both ends."""
    packed = sorted(ipaddress.IPv6Address(each).packed for each in (one, other))
    digest = hashlib.sha256(b"gdp-tunnel-vni-1" + b"".join(packed)).digest()
    return int.from_bytes(digest[:_VNI_BYTES], "big") or 1
