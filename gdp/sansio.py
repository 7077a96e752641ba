"""Sans-I/O interface: what a protocol core receives from its I/O layer, and what it returns.

Sans-I/O. Source: sans-io.readthedocs.io. A protocol core holds no socket and no clock. An I/O layer passes it received
frames and the time, and takes out frames to send and the time of the next call.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple, Protocol

BROADCAST: Final = b"\xff" * 6
new_tuple: Final = tuple.__new__  # of a named tuple: one call, where its constructor is two and ``_make`` three


class Timestamps(NamedTuple):
    """One moment on two clocks."""

    mono_s: float  # monotonic: leases and timers
    unix_s: float  # wall clock: validity of certificates only


class ReceivedFrame(NamedTuple):
    """A frame that was punted to the protocol core."""

    port: int
    mac: bytes  # the sender's, 6 bytes
    frame: bytes  # from the header on, without the Ethernet header; may end in padding
    waited_s: float = 0.0  # seconds between its arrival and its processing, if known

    @property
    def via(self) -> bytes:
        """Return port and sender's address as one key."""
        return self.port.to_bytes(4, "big") + self.mac


class OutgoingFrames(NamedTuple):
    """Frames to one neighbour, in order."""

    port: int
    mac: bytes  # the receiver's, 6 bytes
    frames: Sequence[bytes]  # each from the header on


class KeepaliveOffer(NamedTuple):
    """A keepalive session that brings no news, as it is now; a data plane may run it.

    The plane then sends and receives its keepalives alone, as a device does for BFD (RFC 5880), and hands the session
    back with the first one that brings news, or when the neighbour is silent.

    Attributes:
        name: of the neighbour.
        nonce: of the neighbour's session.
        mac: of the neighbour, 6 bytes.
        header: of our keepalives; the number is that of the last one.
        head: payload of ours before the report.
        expected: the same of the neighbour's, with 0 for the multiplier; others bring news.
        loss: of the neighbour's keepalives, in 255ths.
        sent: count of keepalives that were sent to the neighbour.
        received: number of the last one that came.
        echo: its count.
        heard_s: when it came.
        send_at_s: when ours is due.
        suspect_s: silence after which the neighbour is polled.
    """

    port: int
    name: bytes
    nonce: bytes
    mac: bytes
    in_key: bytes
    out_key: bytes
    header: bytes
    head: bytes
    expected: bytes
    loss: int
    sequence: int
    sent: int
    received: int
    echo: int
    heard_s: float
    send_at_s: float
    out_interval_s: float
    suspect_s: float


class KeepaliveRun(NamedTuple):
    """What happened in a session since the last report.

    Attributes:
        sent_s: when keepalives were sent.
        sequence: number of the last one.
        taken: how many of the neighbour's came.
        received: number of the last one, here or before.
        heard_s: when it came.
        report: on the link, of the last one.
        multiplier: of the last one; 0: none came since the session was handed over.
        replays: how many others were refused.
        send_at_s: when ours is due.
        is_over: the data plane has handed the session back.
    """

    port: int
    name: bytes
    nonce: bytes
    sent_s: tuple[float, ...] = ()
    sequence: int = 0
    taken: int = 0
    received: int = 0
    heard_s: float = 0.0
    report: tuple[int, ...] = ()
    multiplier: int = 0
    replays: int = 0
    send_at_s: float = 0.0
    is_over: bool = False

    @classmethod
    def from_fields(cls, fields: Sequence[Any]) -> KeepaliveRun:
        """Return the run that a journal has."""
        run = cls(*fields)
        return run._replace(sent_s=tuple(run.sent_s), report=tuple(run.report))


class KeepaliveOffload(Protocol):
    """Keepalive sessions of a protocol core, as far as a data plane may run them."""

    def offers(self, now_s: float) -> list[KeepaliveOffer]:
        """Return the sessions that a data plane may run; those that are not among them are the core's."""

    def take_runs(self, runs: list[KeepaliveRun], late_s: float, now: Timestamps) -> None:
        """Note what a data plane did in sessions; it was called so much later than it had requested."""

    def frames_came(self, now_s: float) -> bool:
        """Note that frames were received; return whether the core's timers are to run now, before they are due."""

    def latest_s(self, due_s: float) -> float:
        """Return until when a timer that is due at a monotonic second may wait for frames."""


class ProtocolCore(Protocol):
    """A switch, a RIB or a participant, as an I/O layer or a simulated network drives it."""

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        """Begin to use a port.

        Args:
            mtu: bytes after the Ethernet header.
            cost: of its links; ``COST_AUTO``: measured.
        """

    def count_arrivals(self, frames_from: Callable[[int], int]) -> None:
        """Learn how to count the frames that have come from a port, those too that a data plane keeps from the core."""

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        """Process received frames; never raises for what they contain."""

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        """Update the state of a port's link."""

    def handle_timer(self, now: Timestamps) -> None:
        """Process the timers that are due; harmless when none is."""

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""

    def poll_neighbours(self) -> Mapping[int, frozenset[bytes]]:
        """Return, once, the addresses of neighbours, former ones too, at each port where they have changed."""

    def frames_to_send(self, now_s: float) -> list[OutgoingFrames]:
        """Return, once, the frames to send; call again until it returns none."""

    def frames_sent(self, now_s: float) -> None:
        """Note that the frames returned last are sent now: preparing them took time."""


class NodeCore(ProtocolCore, Protocol):
    """A core on a data plane, which may take over keepalive sessions."""

    @property
    def offload(self) -> KeepaliveOffload:
        """The keepalive sessions that a data plane may run."""
