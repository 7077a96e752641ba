"""Sources of a node's metrics: its counts, and the functions that read them.

Sans-I/O. It is separate from the metrics, because their library takes a tenth of a node's start.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from gdp.errors import DropReason
from gdp.names import ZERO, Name
from gdp.telemetry.health import Health

LATENCY_BOUNDS_S: Final = (0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


class Histogram:
    """Histogram of durations.

    Attributes:
        bounds_s: upper ends of the buckets, ascending, each included.
        counts: one per bucket, and one for the durations above all bounds.
        total_s: sum of all durations.
    """

    __slots__ = ("bounds_s", "counts", "total_s")

    def __init__(self, bounds_s: Sequence[float] = LATENCY_BOUNDS_S) -> None:
        self.bounds_s = tuple(bounds_s)
        self.counts = [0] * (len(self.bounds_s) + 1)
        self.total_s = 0.0

    def observe(self, duration_s: float) -> None:
        """Count a duration in seconds."""
        self.counts[bisect_left(self.bounds_s, duration_s)] += 1
        self.total_s += duration_s


Counts = Callable[[], Mapping[str, int]]  # label value to count
Gauge = Callable[[], float]


@dataclass(frozen=True, slots=True, kw_only=True)
class NeighbourRow:
    """One neighbour, and the link to it as it is measured now.

    Attributes:
        port: device name.
        label: of its membership; empty before that is known.
        role, state: values of ``Role``, and names of ``NeighbourState`` in lower case.
        mac: its address, 6 bytes.
        mtu: of the link, bytes after the Ethernet header.
        cost: what a path pays.
        rtt_s: smoothed round-trip time, seconds; None before the first measurement.
        rtt_var_s: its mean deviation.
        loss_in: share of frames lost on the way here, 0 to 1.
        loss_out: share lost on the way to the neighbour.
    """

    port: str
    name: Name
    label: str = ""
    role: str = ""
    domain: Name = ZERO
    state: str = "up"
    mac: bytes = b""
    mtu: int = 0
    cost: int = 0
    rtt_s: float | None = None
    rtt_var_s: float = 0.0
    loss_in: float = 0.0
    loss_out: float = 0.0


class DeviceCounts(NamedTuple):
    """What the kernel counted at a device since it was made: all protocols together."""

    frames_in: int
    frames_out: int
    bytes_in: int
    bytes_out: int
    errors_in: int
    errors_out: int
    drops_in: int
    drops_out: int


class PortRow(NamedTuple):
    """One port.

    Attributes:
        port: device name.
        mtu: bytes after the Ethernet header.
        counts: None while there is no such device.
    """

    port: str
    is_up: bool
    mtu: int
    counts: DeviceCounts | None


class TopicCounts(NamedTuple):
    """One topic that a proxy carries now, in one direction.

    Attributes:
        topic: short overlay name, or the local ROS name where the configuration allows it.
        direction: in or out.
        messages: since the flow began.
        size: their bytes in ROS's wire form.
        lost: messages that did not arrive, or that did not leave.
        readers: of an outgoing topic, on the overlay; None for an incoming one.
    """

    topic: str
    direction: str
    messages: int
    size: int
    lost: int
    readers: int | None


EntryCounts = Callable[[], Mapping[bytes, tuple[int, int]]]  # table key to frames and bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class Sources:
    """Functions that return a node's counts, called in another thread on each scrape; None: there is no such count.

    Attributes:
        frames: by direction: in, out, forwarded, punted.
        drops: what the node dropped, by reason.
        table_entries: entries of the forwarding table.
        entries: frames and bytes forwarded by the busiest entries, by the table's key.
        pending_frames: frames that wait for a name resolution.
        rib_answers: a RIB's responses by result.
        rib_refusals: a RIB's rejections by reason.
        messages: whole messages by direction.
        message_bytes: their bytes by direction, before sealing.
        repairs: lost fragments by result: asked, sent, given-up.
        lost: incoming messages that were lost, by reason.
        unconfirmed: outgoing messages that some reader did not get, by reason.
        faults: what a proxy could not carry, or not correctly, by fault.
        calls: events of services with several servers: late and unexpected responses, hedged requests.
        waiting: 1 for each reason for which the node makes no progress, 0 for the others.
        links: to neighbours that are up.
        clocks: what the wall clocks of other members are ahead of ours, and the bounds of the errors, in seconds.
        ports: with the kernel's counts of their devices.
        topics: that a proxy carries now.
        health: of the loop, for probes.
        two_paths: flows that want two paths, by what they have: disjoint, shared, single.
        clashes: signs of another node with this identity.
        latency: one-way, from the source's stamp to delivery, by the reader's clock where the offset is known.
    """

    frames: Counts | None = None
    drops: Callable[[], Mapping[DropReason, int]] | None = None
    table_entries: Gauge | None = None
    entries: EntryCounts | None = None
    pending_frames: Gauge | None = None
    rib_answers: Counts | None = None
    rib_refusals: Counts | None = None
    messages: Counts | None = None
    message_bytes: Counts | None = None
    repairs: Counts | None = None
    lost: Counts | None = None
    unconfirmed: Counts | None = None
    faults: Counts | None = None
    calls: Counts | None = None
    waiting: Counts | None = None
    links: Callable[[], Sequence[NeighbourRow]] | None = None
    clocks: Callable[[], Mapping[str, tuple[float, float]]] | None = None
    ports: Callable[[], Sequence[PortRow]] | None = None
    topics: Callable[[], Sequence[TopicCounts]] | None = None
    health: Callable[[], Health] | None = None
    two_paths: Counts | None = None
    clashes: Gauge | None = None
    latency: Callable[[], Histogram] | None = None
