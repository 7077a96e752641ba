"""Configuration of a WireGuard device: what both kinds of device accept and report.

I/O layer, without I/O of its own. Source: ``include/uapi/linux/wireguard.h``; the cross-platform userspace interface of
WireGuard (https://www.wireguard.com/xplatform/).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from gdp.control.endpoints import Endpoint
from gdp.errors import LocalError


class ControlLostError(LocalError):
    """The process behind the device does not respond; its keeper starts it again."""


class PeerState(NamedTuple):
    """State of one peer.

    Attributes:
        endpoint: where its packets go; None: not known yet.
        handshake_unix_s: the last completed handshake; 0.0: none yet.
        received_bytes: on the wire, from the peer.
        sent_bytes: on the wire, to the peer.
    """

    endpoint: Endpoint | None
    handshake_unix_s: float
    received_bytes: int
    sent_bytes: int


class DeviceState(NamedTuple):
    """State of a device: its UDP port and its peers by public key."""

    listen_port: int
    peers: dict[bytes, PeerState]


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerChange:
    """Change of one peer.

    Args:
        public_key: 32 bytes.
        inner: the peer's inner IPv6 address, the only one that it may use; empty: as before.
        endpoint: None: as before.
        keepalive_s: seconds between keepalives; 0: none; None: as before. A packet leaves at once if it was 0.
        preshared_key: 32 bytes, of which zeros mean none, from the next handshake on; empty: as before.
        is_removed: whether the peer is removed; nothing else applies then.
    """

    public_key: bytes
    inner: str = ""
    endpoint: Endpoint | None = None
    keepalive_s: int | None = None
    preshared_key: bytes = field(default=b"", repr=False)
    is_removed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """Change of a device; None: as before.

    Args:
        private_key: 32 bytes.
        listen_port: UDP port; setting the same one again forgets cached source addresses.
        fwmark: mark of the packets; 0: none.
        peers: in the order in which they are made.
    """

    private_key: bytes | None = field(default=None, repr=False)
    listen_port: int | None = None
    fwmark: int | None = None
    peers: tuple[PeerChange, ...] = ()


class WireGuardControl(Protocol):
    """The control interface of one device.

    Every method raises ``ControlLostError`` if the process behind the device is not there, and ``LocalError`` if the
    change is refused.
    """

    def apply(self, change: Change) -> None:
        """Change the device."""

    def state(self) -> DeviceState:
        """Return the device's state."""

    def resume(self) -> None:
        """Ask a process again that did not respond: it was restarted."""
