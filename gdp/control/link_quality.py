"""Quality of the link to one neighbour: round-trip time and loss in each direction, measured by keepalives.

Sans-I/O; time comes in as monotonic seconds. Each keepalive carries a ``LinkReport``: the sender's count, the last
count that it received, and for how long it has held that one. So no clock of another node takes part (RFC 9616,
section 3.2, echoes the timestamps of hellos). A count is kept for each neighbour; the frame's number is the port's.

Smoothing is that of RFC 6298, section 2, over the minimum of each half second: a busy machine delays some frames, never
all of them. Loss is counted from gaps in the counts. A frame that another one overtook is refused, and counts as lost.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

from gdp.control.link_cost import DampedCost, link_cost

LOSS_WINDOW: Final = 256  # keepalives; 18 s at the default interval
_LOSS_SEEN_MIN: Final = 64  # of fewer keepalives one lost frame would look like a bad link
_MASK: Final = (1 << LOSS_WINDOW) - 1
_BLOCK_S: Final = 0.5  # the least round trip of this time counts
_SENT_MAX: Final = 256  # keepalives whose echo may still come
_HELD_MAX_US: Final = (1 << 32) - 1
_LOSS_UNIT: Final = 255


class LinkReport(NamedTuple):
    """What a keepalive reports on the link.

    Attributes:
        sent: count of keepalives that the sender has sent to this neighbour, this one included.
        echo: the last count that the sender received from this neighbour; 0: none in this session.
        held_us: microseconds from the arrival of that one to the sending of this one.
        loss: of the neighbour's keepalives on their way to the sender, in 255ths.
    """

    sent: int = 0
    echo: int = 0
    held_us: int = 0
    loss: int = 0


class RttEstimator:
    """Smoothed round-trip time and its variation.

    Attributes:
        srtt_s: smoothed round-trip time in seconds; None before the first block of samples has ended.
        rttvar_s: its mean deviation.
    """

    __slots__ = ("_block_ends_s", "_least_s", "rttvar_s", "srtt_s")

    def __init__(self) -> None:
        self.srtt_s: float | None = None
        self.rttvar_s = 0.0
        self._least_s = float("inf")
        self._block_ends_s: float | None = None

    def add(self, sample_s: float, now_s: float, *, is_block: bool = False) -> bool:
        """Add a round-trip time in seconds; return whether the smoothed one is new.

        Args:
            is_block: it stands for more than one keepalive.
        """
        self._least_s = min(self._least_s, sample_s)
        if self._block_ends_s is None:
            self._block_ends_s = now_s + _BLOCK_S
        if now_s < self._block_ends_s and not is_block:
            return False
        least_s, self._least_s, self._block_ends_s = self._least_s, float("inf"), None
        if self.srtt_s is None:
            self.srtt_s, self.rttvar_s = least_s, least_s / 2
        else:
            self.rttvar_s += (abs(self.srtt_s - least_s) - self.rttvar_s) / 4
            self.srtt_s += (least_s - self.srtt_s) / 8
        return True


class LossWindow:
    """Share of the last ``LOSS_WINDOW`` keepalives of a neighbour that did not come."""

    __slots__ = ("_arrived", "_last", "_seen")

    def __init__(self) -> None:
        self._arrived = 1  # one bit for each keepalive, the last one lowest; the bit above all marks nothing
        self._last: int | None = None
        self._seen = 0

    def begin_session(self) -> None:
        """Take the next count as the first one: those before it are of another session."""
        self._last = None

    def record(self, count: int, came: int = 1) -> None:
        """Record the arrival of a keepalive with this count, the last one of ``came``."""
        is_next = self._last is not None and count > self._last
        passed = min(count - self._last, LOSS_WINDOW) if self._last is not None and is_next else 1
        self._last = count
        self._arrived = ((self._arrived << passed) | ((1 << min(came, passed)) - 1)) & _MASK
        self._seen = min(self._seen + passed, LOSS_WINDOW)

    @property
    def loss(self) -> float:
        """Return the share that was lost, from 0 to below 1."""
        lost = self._seen - (self._arrived & ((1 << self._seen) - 1)).bit_count()
        return lost / max(self._seen, _LOSS_SEEN_MIN)


class LinkQuality:
    """Measurements of the link to one neighbour, which outlast its sessions.

    Attributes:
        rtt: round-trip time.
        loss_out: share of our keepalives that the neighbour reports as lost, 0 to 1.
        cost: cost of the link that follows from both, damped.
        confirmed_s: when the last of our keepalives that the neighbour has echoed was sent.
    """

    __slots__ = ("_count", "_heard_s", "_in", "_received", "_sent_s", "confirmed_s", "cost", "loss_out", "rtt")

    def __init__(self) -> None:
        self.rtt = RttEstimator()
        self.loss_out = 0.0
        self.cost = DampedCost()
        self.confirmed_s = float("-inf")
        self._in = LossWindow()
        self._count = 0
        self._sent_s: deque[float] = deque(maxlen=_SENT_MAX)  # the last one is of ``_count``
        self._received = 0
        self._heard_s = 0.0

    @property
    def loss_in(self) -> float:
        """Return the share of the neighbour's keepalives that was lost on the way here, 0 to below 1."""
        return self._in.loss

    def begin_session(self) -> None:
        """Forget which keepalive came last: the neighbour may count from the beginning again."""
        self._received = 0
        self._in.begin_session()

    @property
    def sent(self) -> int:
        """Return the count of keepalives that were sent to this neighbour."""
        return self._count

    @property
    def received(self) -> int:
        """Return the count of the last keepalive that came; 0: none in this session."""
        return self._received

    @property
    def loss_to_report(self) -> int:
        """Return the share of the neighbour's keepalives that was lost, in 255ths."""
        return round(_LOSS_UNIT * self.loss_in)

    def note_sent(self, sent_s: Sequence[float]) -> None:
        """Note when a data plane has sent keepalives."""
        self._count += len(sent_s)
        self._sent_s.extend(sent_s)

    def report_to_send(self, now_s: float) -> LinkReport:
        """Return the report of the keepalive that is sent now."""
        self._count += 1
        self._sent_s.append(now_s)
        held_us = min(max(int((now_s - self._heard_s) * 1e6), 0), _HELD_MAX_US) if self._received else 0
        return LinkReport(self._count, self._received, held_us, self.loss_to_report)

    def receive(self, report: LinkReport, heard_s: float, came: int = 1) -> bool:
        """Process the report of an authenticated keepalive; return whether the damped cost is another one now.

        A neighbour can report a wrong time, as it can name a wrong cost for its own end. No other node can: reports are
        authenticated, and a delayed frame only looks slower. An impossible time is ignored.

        Args:
            heard_s: when the keepalive arrived.
            came: how many came since the last report, this one included.
        """
        self._received, self._heard_s = report.sent, heard_s
        self._in.record(report.sent, came)
        self.loss_out = report.loss / _LOSS_UNIT
        age = self._count - report.echo
        if not report.echo or not 0 <= age < len(self._sent_s):
            return False
        self.confirmed_s = self._sent_s[-1 - age]
        rtt_s = heard_s - self.confirmed_s - report.held_us / 1e6
        if rtt_s < 0 or not self.rtt.add(rtt_s, heard_s, is_block=came > 1):
            return False
        return self.cost.update(link_cost(self.rtt.srtt_s or 0.0, self.loss_in, self.loss_out), heard_s)
