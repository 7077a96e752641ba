"""Interface of a data plane to its node: ports, punted frames, frames to send.

I/O layer; this module has only the Protocol and its data types, and makes no system call.
Source: docs/explanation/design.md, section 7.
A plane forwards by itself what the table decides; a node sees only the punted frames.
A plane without a table (of a proxy or a RIB) punts every frame.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

from gdp.errors import DROP_COUNTERS
from gdp.sansio import KeepaliveOffer, KeepaliveRun, ReceivedFrame

MAC_BYTES: Final = 6


@dataclass(frozen=True, slots=True)
class Port:
    """One layer-2 device in its last known state.

    Attributes:
        index: the plane's own number of this port; unlike the kernel's, it is never reused.
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
    """Counts of a plane since its creation.

    Attributes:
        frames_in: frames received from ports.
        frames_out: frames sent on ports, forwarded copies and our own.
        forwarded: the copies among them that the table requested.
        punted: frames delivered to the node.
        drops: by ``DropReason``; a frame with several hops may count once for each.
    """

    frames_in: int = 0
    frames_out: int = 0
    forwarded: int = 0
    punted: int = 0
    drops: list[int] = field(default_factory=lambda: [0] * DROP_COUNTERS)


class HasFileno(Protocol):
    """Object that epoll can watch."""

    def fileno(self) -> int:
        """Return the descriptor to wait on."""


LinkCallback = Callable[[int, bool], None]


class Keepalives(Protocol):
    """Keepalive sessions that a data plane runs.

    Attributes:
        due_s: monotonic second at which the plane works next; infinity: it runs no session.
        has_news: ``poll`` has something to return that cannot wait.
    """

    due_s: float
    has_news: bool

    def follow(self, offers: Sequence[KeepaliveOffer], ports: Mapping[int, Port]) -> list[KeepaliveRun]:
        """Run the sessions of these offers and no others; return the begin and the end of each where that is new."""

    def poll(self, now_s: float, *, reports: bool = False) -> tuple[list[KeepaliveRun], float]:
        """Return what happened in the sessions that end, and how late the plane was called, in seconds.

        Args:
            reports: also what happened in the others.
        """


class Plane(Protocol):
    """A data plane. One thread uses it; nothing here blocks except ``poll``."""

    @property
    def ports(self) -> Mapping[int, Port]:
        """The ports by index, up or not."""

    @property
    def keepalives(self) -> Keepalives | None:
        """The keepalive sessions that the plane runs; None: the node runs all."""

    @property
    def counters(self) -> Counters:
        """The live counts; any thread may read them.

        Frames that the kernel dropped at a full socket (``PORT_FULL``) are added in the next idle ``poll``, or in the
        256th busy one. An idle one that does not wait counts only if frames came since.
        """

    def poll(self, timeout_s: float | None) -> Sequence[ReceivedFrame]:
        """Wait for frames, forward what the table decides, return the punted frames.

        Returns early, perhaps with an empty list, after any event: frames forwarded, a link that changed, a watched
        file that was ready. Call it in a loop.

        Args:
            timeout_s: longest wait; 0 does not wait, None waits without a limit.
        """

    def transmit(self, port: int, destination_mac: bytes, frames: Sequence[bytes]) -> int:
        """Send frames of ours (from the GDP header on; the plane adds the Ethernet header) to one neighbour.

        Returns how many were sent. The others are lost, and counted as ``PORT_FULL``, ``PORT_DOWN`` or ``TOO_BIG``; a
        removed port counts as down.
        """

    def watch(self, source: HasFileno, ready: Callable[[], None]) -> None:
        """Call ``ready`` from within ``poll`` whenever ``source`` is readable."""

    def unwatch(self, source: HasFileno) -> None:
        """Undo ``watch``, before the source is closed."""

    def add_port(self, ifname: str, *, may_be_absent: bool = False) -> int:
        """Open a device and return its port index; a device that may be absent is opened when it appears.

        Raises:
            LocalError: the device does not exist, its MTU is too small, it is already a port, or the process may not
                open raw sockets.
        """

    def remove_port(self, index: int) -> None:
        """Close a port; hops that still name it count as ``PORT_DOWN``."""

    def port_state(self, index: int) -> bool:
        """Return whether the port exists, is up and has a carrier."""

    def frames_from(self, port: int) -> int:
        """Return how many frames have come from a port since its creation, forwarded and dropped ones too."""

    def on_link(self, callback: LinkCallback) -> None:
        """Call ``callback(port, up)`` from within ``poll`` each time a port goes up or down.

        If only the MTU changed, the callback gets ``up`` again. If the address changed, it gets down and then up: to
        its neighbours the port is another one. ``ports`` has the new state.
        """

    def set_neighbours(self, port: int, macs: Collection[bytes]) -> None:
        """Store the addresses of a port's neighbours; their frames precede those of strangers."""

    def close(self) -> None:
        """Close every socket; the plane is unusable afterwards."""
