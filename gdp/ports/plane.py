"""What a data plane is to the node that runs it: ports, frames handed up, frames to send.

Place: I/O floor; the Protocol and its nouns, no system call.
Source: docs/explanation/design.md, section 7.
A plane forwards by itself whatever the table decides; a node sees only what was handed up.
A plane without a table (a proxy's, a RIB's) hands everything up.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

from gdp.errors import DROP_COUNTERS
from gdp.sansio import BROADCAST, ReceivedFrame

__all__ = ["BROADCAST", "MAC_BYTES", "Counters", "HasFileno", "LinkCallback", "Plane", "Port", "ReceivedFrame"]

MAC_BYTES: Final = 6


@dataclass(frozen=True, slots=True)
class Port:
    """One layer-2 device, as it was last heard of.

    Attributes:
        index: the plane's own number of this port; never given to another one, unlike the kernel's.
        mac: its address, 6 bytes.
        mtu: bytes after the Ethernet header.
        up: switched on and with a carrier.
    """

    index: int
    ifname: str
    mac: bytes
    mtu: int
    up: bool


@dataclass(slots=True)
class Counters:
    """What a plane has done since it was made.

    Attributes:
        frames_in: frames taken from ports.
        frames_out: frames put on ports, forwarded copies and our own.
        forwarded: the copies among them that the table asked for.
        punted: frames given to the node.
        drops: by ``DropReason``; a frame with several hops may be counted for each.
    """

    frames_in: int = 0
    frames_out: int = 0
    forwarded: int = 0
    punted: int = 0
    drops: list[int] = field(default_factory=lambda: [0] * DROP_COUNTERS)


class HasFileno(Protocol):
    """Anything that epoll can watch."""

    def fileno(self) -> int:
        """Return the descriptor to wait on."""


LinkCallback = Callable[[int, bool], None]


class Plane(Protocol):
    """A data plane. One thread uses it; nothing here blocks except ``poll``."""

    @property
    def ports(self) -> Mapping[int, Port]:
        """The ports by index, up or not."""

    @property
    def counters(self) -> Counters:
        """The live counts; any thread may read them. What the kernel dropped at a full socket (``PORT_FULL``) comes in
        with the next idle ``poll``, or the 256th busy one."""

    def poll(self, timeout_s: float | None) -> list[ReceivedFrame]:
        """Wait for frames, forward what the table decides, return what is handed up.

        Returns early, perhaps with nothing, whenever anything happened: frames forwarded, a link that came or went,
        a watched file that was ready. Call it in a loop.

        Args:
            timeout_s: longest wait; 0 only looks, None waits for as long as it takes.
        """

    def transmit(self, port: int, destination_mac: bytes, frames: Sequence[bytes]) -> int:
        """Send frames of ours (from the GDP header on; the Ethernet header is added) to one neighbour.

        Returns how many left. The others are lost, and counted as ``PORT_FULL``, ``PORT_DOWN`` or ``TOO_BIG``; a port
        that was removed is down.
        """

    def watch(self, source: HasFileno, ready: Callable[[], None]) -> None:
        """Call ``ready`` from within ``poll`` whenever ``source`` can be read."""

    def unwatch(self, source: HasFileno) -> None:
        """Undo ``watch``, before the source is closed."""

    def add_port(self, ifname: str, *, may_be_absent: bool = False) -> int:
        """Open a device and return its port index; one that may be absent is opened when it appears.

        Raises:
            LocalError: no such device, its MTU is too small, it is a port already, or raw sockets are not allowed here.
        """

    def remove_port(self, index: int) -> None:
        """Close a port; hops that still name it count as ``PORT_DOWN``."""

    def port_state(self, index: int) -> bool:
        """Say whether the port exists, is up and has a carrier."""

    def on_link(self, callback: LinkCallback) -> None:
        """Call ``callback(port, up)`` from within ``poll`` each time a port goes up or down.

        It is called with ``up`` again where only the MTU changed, and with down and up where the address did: to its
        neighbours that is another port. ``ports`` has the new facts.
        """

    def set_neighbours(self, port: int, macs: Collection[bytes]) -> None:
        """Learn the addresses of a port's neighbours; what they say goes before what strangers say."""

    def close(self) -> None:
        """Close every socket; the plane is of no use afterwards."""
