"""Congestion controller of what may wait: it takes what the other traffic of the path leaves, and yields to all of it.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: LEDBAT (RFC 6817) and LEDBAT++
(draft-irtf-iccrg-ledbat-plus-plus) for the delay as the signal, the slower-than-path target and the slow increase. What
differs: a rate governs, not a window. Frames leave at ``_SHARE`` of what the path was measured to carry, so none of
them stands in a queue.

- **Own traffic.** All frames of this participant count against that rate, those of other paths too, because an uplink
  is common to them. So while a queue of live frames may stand at the bottleneck, no frame of this controller leaves.
- **Traffic of others.** A queueing delay above the noise of programs and a frame pauses it until the queue is over,
  and lowers the rate to what the growth of the queue shows.
- **Increase.** Below the rate at which a queue grew last it returns fast. Above it, it tries a little more now
  and then, and more while nothing else is sent.
- **Busy machines.** A delay is no queue while reports wait so long for this program; what such a delay taught is void.
- **Starvation.** A frame may leave each ``DELAY_MOST_S``, else nothing would be measured.
"""

from __future__ import annotations

from typing import ClassVar, Final

from gdp.congestion.controller import PathController
from gdp.congestion.delivery_rate import Flight
from gdp.congestion.pacer import DELAY_MOST_S, Pacer
from gdp.congestion.path_model import BASE_WINDOW_S, NOISE_S
from gdp.congestion.states import Signal
from gdp.intervals import MINUTE_S
from gdp.limits import REPORT_DELAY_S

_LEAST_FRAMES: Final = 2
_SHARE: Final = 0.95  # of what the path carries
_QUEUE_DELAYS: Final = 4  # of the longest queue that live traffic may have
_AHEAD: Final = 1.5  # times what is under way at this rate, so that late reports cost nothing
_RETURN, _TRY, _TRY_LEAST = 0.5, 0.05, 0.01  # increase of the rate
_USED: Final = 0.75  # of the rate left, so the path was tried
_TRIPS: Final = 4  # in which a queue has grown, at most
_REACHED: Final = 0.9
_LOST_MOST: Final = 0.5
_LOSS, _LOSS_FRAMES = 0.2, 50  # the queue is shorter than the delay that would show it


class CommonPacer(Pacer):
    """Pace of all frames of a participant; those of one path wait until the others have passed the link.

    Attributes:
        charged: bytes so far.
        left_s: when a frame of that path left last.
    """

    def __init__(self, mtu: int) -> None:
        super().__init__(mtu)
        self.charged = 0
        self.left_s = self._at_s = float("-inf")
        self._queued = 0.0  # bytes at ``_at_s``; below 0: what a late sender may catch up

    def charge(self, size: int, now_s: float) -> None:
        """Delay what follows by the time that so many bytes take, within ``DELAY_MOST_S`` after the last frame."""
        self.charged += size
        if self.bytes_s < float("inf"):
            least = -self.credit_s * self.bytes_s if self.is_paced else 0.0
            self._queue(max(self.left_bytes(now_s), least) + size, now_s)

    def pause(self, pause_s: float, now_s: float) -> None:
        """Let nothing leave for a time."""
        self._queue(max(self.left_bytes(now_s), pause_s * self.bytes_s), now_s)

    def left_bytes(self, now_s: float) -> float:
        """Return how many bytes may stand in the queue of the link."""
        return self._queued - (now_s - self._at_s) * self.bytes_s

    def _queue(self, size: float, now_s: float) -> None:
        self._queued, self._at_s = min(size, _QUEUE_DELAYS * DELAY_MOST_S * self.bytes_s), now_s
        self.due_s = min(now_s + self._queued / self.bytes_s, max(self.left_s + DELAY_MOST_S, now_s))


class ScavengingController(PathController):
    """Controller of one path for what may wait; used as ``PathController``.

    Attributes:
        pace: it is charged with the frames of all paths of the participant.
    """

    burst_frames: ClassVar[int] = 0
    pace: CommonPacer

    def __init__(self, mtu: int) -> None:
        self._bytes_s = 0.0
        super().__init__(mtu)
        self.pace = CommonPacer(mtu)
        self._set_limits()

    def _start(self) -> None:
        super()._start()
        self._bytes_s, self._ceiling = 0.0, float("inf")
        self._unseen_s = self._reduced_s = self._tried_s = self._raised_s = self._begun_s = float("-inf")
        self._begun_charged = self._begun_others = 0
        self._try, self._proven, self._grown_s = _TRY, 0.0, float("inf")

    def _set_limits(self) -> None:
        model, least = self.model, float(_LEAST_FRAMES * self._mtu)
        if model.rtt_s is not None and not self._bytes_s:
            self._bytes_s = least / model.rtt_s
        trip_s = model.base_rtt_s + REPORT_DELAY_S + 2 * model.late_s  # the reader's program may be as late
        ahead = 0.0 if model.rtt_s is None else _AHEAD * self._bytes_s * trip_s
        self.window = self.limit = max(ahead, least)
        self.pace.set_rate(self._bytes_s or float("inf"), model.rtt_s or 0.0)

    def sent(self, size: int, now_s: float, frames: int = 1) -> Flight:
        """Count and return a flight of so many bytes and frames, which leaves now."""
        if self._ceiling < float("inf") and self.pace.left_bytes(now_s) > self._mtu:
            self._unseen_s = now_s  # it joins a queue of others
        self.pace.left_s = now_s
        return super().sent(size, now_s, frames)

    def timed_out(self, now_s: float) -> None:
        """Start again with two frames, and then half of the rate: the path was gone, and may be the same."""
        bytes_s, ceiling = self._bytes_s, self._ceiling
        bytes_s *= 1.0 if self.model.rtt_s is None else 0.5  # once, however long it is gone
        super().timed_out(now_s)
        self._bytes_s, self._ceiling = bytes_s, ceiling
        self._set_limits()

    def _note_queue(self, now_s: float) -> None:
        """A queue that empties is no signal: none is to stand."""

    def _adapt(self, size: int, newest: Flight, now_s: float) -> None:
        del size
        model = self.model
        bytes_s, noise = self._bytes_s, max(model.late_s * self._bytes_s, self._mtu)
        if newest.sent_s <= self._unseen_s or model.queue_s * bytes_s <= noise:
            return
        queue_s, grew_s = model.standing_s - model.base_rtt_s, max(_TRIPS * model.base_rtt_s, REPORT_DELAY_S)
        if self._raised_s > self._reduced_s:
            grew_s = min(max(newest.sent_s - self._raised_s, queue_s), grew_s)
        carried = self._bytes_s / (1 + queue_s / grew_s)
        if self.pace.others == self._begun_others:
            carried = min(carried, model.bytes_s / (1 - min(model.loss, _LOST_MOST)) or carried)
        self._reduce(max(carried, _SHARE * self._proven), now_s)
        self.pace.pause(max(queue_s, self.rate.inflight / carried - model.base_rtt_s), now_s)

    def _reduce(self, carried: float, now_s: float) -> None:
        """Lower the rate: the path carries so many bytes a second."""
        is_reached = self._bytes_s >= _REACHED * self._ceiling or self._ceiling == float("inf")
        self._ceiling = carried if is_reached else (self._ceiling + carried) / 2
        self._bytes_s, self._try, self._proven = max(_SHARE * carried, self._mtu / DELAY_MOST_S), _TRY, 0.0
        self._grown_s = self.model.queue_s
        self._unseen_s = self._reduced_s = self._tried_s = now_s
        self._begin(now_s)
        self._signal(Signal.PATH_FULL, now_s)

    def _begin(self, now_s: float) -> None:
        """Begin to see what the present rate does."""
        self._begun_s, self._begun_charged, self._begun_others = now_s, self.pace.charged, self.pace.others
        self._lost_frames = self._round_frames = 0

    def _end_round(self, now_s: float, *, is_used: bool) -> None:
        """Try more where the rate was used and no queue grew; ``is_used``: as of this path alone."""
        del is_used
        if self._round_frames >= _LOSS_FRAMES and self._lost_frames > _LOSS * self._round_frames:
            self._reduce(self._bytes_s * (1 - self._lost_frames / self._round_frames), now_s)
            return
        seen_s = self.confirmed_sent_s - self._begun_s
        if not self._bytes_s or self.confirmed_sent_s <= self._unseen_s or seen_s <= self._shows_s(_RETURN):
            return
        charged, span_s = self.pace.charged - self._begun_charged, now_s - self._begun_s
        if charged < _USED * self._bytes_s * span_s:
            self._begin(now_s)
        else:
            self._grow(charged / span_s, seen_s, now_s, is_alone=self.pace.others == self._begun_others)

    def _grow(self, charged_s: float, seen_s: float, now_s: float, *, is_alone: bool) -> None:
        """Raise the rate; ``charged_s``: bytes of all frames a second, ``seen_s``: for how long this one was tried."""
        if self._grown_s < self.model.late_s:
            self._ceiling = float("inf")  # that queue may have been a program's wait
        below, before, is_new = _SHARE * self._ceiling, self._bytes_s, self._ceiling == float("inf")
        # next to others a round trip of too much makes no more queue than the noise of programs
        more = self._try if is_alone else min(max(NOISE_S / self.model.base_rtt_s, _TRY_LEAST), _TRY)
        may_try = seen_s > self.model.base_rtt_s + self._shows_s(more)
        if (is_new and is_alone) or before < below < float("inf"):
            self._bytes_s = min((1 + _RETURN) * before, below)
        elif is_new and charged_s > (1 + _TRY) * before:
            self._bytes_s = min((1 + _RETURN) * before, charged_s) if seen_s > DELAY_MOST_S else before
        elif may_try and (is_new or now_s > self._tried_s + (BASE_WINDOW_S if is_alone else MINUTE_S)):
            self._bytes_s *= 1 + more
            self._try = min(2 * more, _RETURN)
        if self._bytes_s > before:
            self._raised_s, self._proven = now_s, before if seen_s > self.model.base_rtt_s else 0.0
            self._begin(now_s)

    def _shows_s(self, excess: float) -> float:
        """Return after which time frames that leave too fast by this share make a queue that shows."""
        model = self.model
        return (model.empty_path_s - model.base_rtt_s + max(self._mtu / self._bytes_s, model.late_s)) / excess
