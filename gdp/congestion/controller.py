"""Congestion controller of one path, shared by all its topics: a window and a pace.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Sources: Copa (Arun and Balakrishnan, NSDI 2018) for the
window in the state DELAY and the standing round trip; HyStart++ (RFC 9406, section 4.2) and BBR (Cardwell and others,
draft-ietf-ccwg-bbr) for the end of the start-up; RFC 9438 for COMPETITIVE; Nimbus (SIGCOMM 2022) for PROBE.

What differs from Copa:

- A flow keeps ``max(2, 0.1 sqrt(frames/s))`` frames in the queue, not 2: at high rates two frames are shorter than the
  noise of a clock. The root keeps equal flows equal.
- Next to a flow that fills the queue the window follows CUBIC itself, from half of the path on, and grows back to that
  half after a loss. An AIMD of a frame each round trip, as in Copa, would need minutes behind a queue of a second.
- A flow that had the path for itself for ``_ALONE_S`` keeps that half for ``_CLAIM_S``, whatever is lost. Else the slow
  start of the other one takes nearly all of a long queue, and CUBIC needs a minute to win it back.
- A queue that empties shows no departure where the FIFO is short: both flows have given way. For ``_TRIAL_S`` after a
  competition, a rate under ``_TRIAL_SHARE`` of the one before shows that the other flow is still there.
- Next to another flow nearly half of what leaves is not lost for rounds. Where it is, the path has become thin: its
  former capacity is forgotten.
- The window only grows while it is used, so a camera that pauses keeps a window that was measured.
- Reports confirm many frames at once. What has arrived and is not reported yet does not count against the window, as
  BBR does with what was acknowledged in excess (section 4.6.4.2).
- A queueing delay up to ``_NOISE_S`` counts as none: programs on both ends are scheduled, and read many frames at once.
- Loss alone does not reduce the window, because radio loses frames. Loss of more than a tenth of a round does: the
  queue is then shorter than the one that the flow wants.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import takewhile
from math import sqrt
from typing import Final

from gdp.congestion.cubic import Cubic
from gdp.congestion.delivery_rate import DeliveryRate, Flight, RateSample
from gdp.congestion.filters import WindowedExtreme
from gdp.congestion.states import TRANSITIONS, Signal, State

__all__ = ["FIRST_RTT_S", "PathController"]

_LEAST_FRAMES: Final = 2
_FIRST_FRAMES: Final = 32  # as Google's QUIC; RFC 6928 has 10
FIRST_RTT_S: Final = 0.02  # until one is measured
_LEAST_RTT_S: Final = 1e-5
_DELAY_MOST_S: Final = 0.25  # by the pace; longer only if one frame takes longer
_NOISE_S: Final = 0.002
_HOLD_WINDOW_S, _HOLD_MOST_S = 0.2, 0.01  # of reports; a reader reports at least each 20 ms while frames come
_BASE_WINDOW_S: Final = 10.0  # Copa, section 2
_RATE_ROUNDS: Final = 10
_RECENT_ROUNDS: Final = 2
_CAPACITY_WINDOW_S: Final = 60.0  # longer than a competitor hides what the path can carry
_ETA_S: Final = (0.004, 0.016)  # RFC 9406, section 4.3
_FLAT_ROUNDS, _FLAT_GROWTH = 3, 1.25  # BBR: the pipe is full
_LOSS_FRAMES: Final = 1_000
_QUEUE_SHARE: Final = 0.1
_LEAST_QUEUE: Final = 2.0  # frames; Copa: 1/delta
_GROWTH_SHARE: Final = 0.125  # of the window, in a round trip
_SAME_DIRECTION: Final = 3  # rounds before the velocity doubles
_PACING_STARTUP, _PACING = 2.89, 1.2  # BBR: 2/ln 2 lets the window double each round trip
_CREDIT_SHARE, _CREDIT_MOST_S = 0.125, 0.01  # of a round trip; less than a time slice loses the pace on a busy core
_HEAVY_LOSS, _HEAVY_FRAMES = 0.1, 20
_AFTER_HEAVY: Final = 0.85
_SHRUNK_LOSS, _SHRUNK_ROUNDS = 0.4, 5
_COLLAPSED_SHARE, _COLLAPSED_ROUNDS = 0.05, 2  # a slow start behind a second of queue leaves a flow a fourteenth
_STANDING_BASES: Final = 12  # round trips of the empty path without a nearly empty queue
_STANDING_LEAST_S, _STANDING_MOST_S = 0.5, 3.0
_WANTED_MOST_S: Final = 0.06  # two frames at 0.4 Mbit/s; a longer queue is another flow's
_FALLING_SHARE: Final = 0.5  # of the highest queue of the last round trips
_FULL_SHARE: Final = 0.9
_FULL_ROUNDS: Final = 3
_FALL_SHARE: Final = 0.7
_DRAIN_QUEUES: Final = 4  # so many times the wanted queue is drained at once
_STANDING_S: Final = 0.005  # a shorter queue is no competitor
_EMPTY_SHARE: Final = 0.1  # of the highest queue; Copa, section 2.2
_PROBE_S: Final = (10.0, 60.0)  # first pause before a probe, and the longest one
_PROBE_SHARE: Final = 0.5
_CLAIM_S, _ALONE_S = 10.0, 2.0
_TRIAL_S, _TRIAL_SHARE, _TRIAL_ROUNDS = 10.0, 0.8, 6


class PathController:
    """Controller of one path.

    A flight is one frame, or a few that leave at once. The caller reports each flight that leaves, is confirmed, or is
    taken for lost, and asks ``next_send_s`` before it sends.

    Args:
        mtu: bytes of a full frame.

    Attributes:
        state: what governs the window.
        window: bytes that may be under way.
        inflight: bytes that are.
        limit: bytes that may be unconfirmed: those under way, and those that the reader has not reported yet.
        rtt_s: smoothed round trip; None before the first one.
        loss: share of frames that were lost lately, 0 to 1.
        confirmed_sent_s: when the newest flight left that was confirmed.
        due_s: monotonic second of the next frame by the pace alone.
        pacing_bytes_s: rate at which frames may leave; none is limited before the first round trip.
    """

    def __init__(self, mtu: int) -> None:
        self.state = State.STARTUP
        self._mtu = mtu
        self._rate = DeliveryRate()
        self._flights: dict[Flight, None] = {}  # in the order in which they left
        self._leaving: list[Flight] = []  # counted, and perhaps not sealed yet
        self.inflight = 0
        self.due_s = self._changed_s = self.loss = 0.0
        self.confirmed_sent_s = float("-inf")
        self._is_paced = False
        self.window = float(_FIRST_FRAMES * mtu)
        self._start()
        self._set_limits()

    def _start(self) -> None:
        """Forget the path; the window begins no larger than it was, because another path may be as thin."""
        self.window = min(self.window, float(_FIRST_FRAMES * self._mtu))
        self.rtt_s: float | None = None
        self._base = WindowedExtreme(is_lowest=True)
        self._standing = WindowedExtreme(is_lowest=True)
        self._highest = WindowedExtreme(is_lowest=False)
        self._hold = WindowedExtreme(is_lowest=False)
        self._rates = WindowedExtreme(is_lowest=False)
        self._round, self._round_end, self._round_s = 0, self._rate.delivered, 0.0
        self._full_rate, self._flat_rounds = 0.0, 0
        self._velocity, self._direction, self._same, self._round_window = 1.0, 0, 0, self.window
        self._was_used = False
        self._lost_frames = self._round_frames = self._reported_lost = 0
        self._round_delivered = self._rate.delivered
        self._empty_s = self._entered_s = 0.0
        self._last_rate = self._capacity = 0.0
        self._recent = WindowedExtreme(is_lowest=False)
        self._peaks = WindowedExtreme(is_lowest=False)
        self._capacities = WindowedExtreme(is_lowest=False)
        self._full_rounds = self.lossy_rounds = 0
        self._probe_from_s = 0.0
        self._cubic: Cubic | None = None
        self._lost_until_s = 0.0
        self._claims_until_s = 0.0
        self._probe_pause_s = _PROBE_S[0]
        self._probe_at_s = self._probe_begun_s = 0.0
        self._shared_rate, self._trial_rounds, self._was_alone = 0.0, 0, False

    @property
    def bytes_s(self) -> float:
        """Return the highest delivery rate of the last rounds; 0 before the first one."""
        return self._rates.value(0.0)

    @property
    def capacity_bytes_s(self) -> float | None:
        """Return the highest rate of the last minute while more waited to be sent; None: nothing waited yet."""
        return self._capacities.value(0.0) or None

    @property
    def base_rtt_s(self) -> float:
        """Return the round trip of the empty path."""
        return self._base.value(FIRST_RTT_S)

    @property
    def queue_s(self) -> float:
        """Return the standing queue of the path, in seconds."""
        return max(self._standing_s - self._empty_path_s, 0.0)

    @property
    def credit_s(self) -> float:
        """Return how much time of the pace a sender that was scheduled late may catch up with."""
        return min(_CREDIT_SHARE * (self.rtt_s or 0.0), _CREDIT_MOST_S) if self._is_paced else 0.0

    def _set_limits(self) -> None:
        """Compute what each sender asks for: after every event, because frames are more frequent."""
        self.limit = self.window + self.bytes_s * self._hold.value(0.0)
        gain = _PACING_STARTUP if self.state is State.STARTUP else _PACING
        self.pacing_bytes_s = float("inf") if self.rtt_s is None else gain * self.window / self._standing_s

    @property
    def _standing_s(self) -> float:
        return self._standing.value(FIRST_RTT_S)

    @property
    def _empty_path_s(self) -> float:
        """Return the longest round trip of a path whose queue is empty."""
        return self.base_rtt_s + _NOISE_S

    def next_send_s(self, size: int) -> float | None:
        """Return when a frame of so many bytes may leave; None: not before something is confirmed or lost."""
        if self.inflight and self.inflight + size > self.limit:
            self._is_paced = False
            return None
        return self.due_s

    def sent(self, size: int, now_s: float, frames: int = 1) -> Flight:
        """Count and return a flight of so many bytes and frames, which leaves now."""
        flight = self._rate.sent(size, now_s, self.inflight, frames)
        self._flights[flight] = None
        self._leaving.append(flight)
        self.inflight += size
        self._was_used = self._was_used or self.inflight + self._mtu > self.window
        self.charge(size, now_s)
        return flight

    def frames_sent(self, now_s: float) -> None:
        """Note when the flights counted since the last call really leave: their frames are sealed after ``sent``."""
        for flight in self._leaving:
            flight.sent_s = now_s
        self._leaving.clear()

    def charge(self, size: int, now_s: float) -> None:
        """Delay what follows by the time that so many bytes take.

        The delay has a bound, because what leaves while another path governs may exceed this one's pace for long.
        """
        pace = self.pacing_bytes_s
        latest_s = now_s + max(_DELAY_MOST_S, self._mtu / pace)
        self.due_s = min(max(self.due_s, now_s - self.credit_s) + size / pace, latest_s)

    def paced(self) -> None:
        """Report that a frame waits only for the pace, until ``next_send_s``: a late sender may catch up."""
        self._is_paced = True

    def app_limited(self) -> None:
        """Report that nothing waits, though a frame might leave."""
        self._rate.app_limited(self.inflight)
        self._is_paced = False

    def acknowledged(
        self, flights: Iterable[Flight], now_s: float, *, held_s: float | None = 0.0, lost: int = 0
    ) -> None:
        """Take an acknowledgement of one flight or many, in any order; those not under way any more are ignored.

        Args:
            held_s: how long the reader held it back; None: it gives no round trip.
            lost: how many of the frames did not arrive.
        """
        newest, first_s, size, frames = None, now_s, 0, 0
        for flight in flights:
            if not self._remove(flight):
                continue
            size, frames, first_s = size + flight.size, frames + flight.frames, min(first_s, flight.sent_s)
            if newest is None or flight.sent_s > newest.sent_s:
                newest = flight
        if newest is None:
            return
        self.confirmed_sent_s = max(self.confirmed_sent_s, newest.sent_s)
        if newest.sent_s < self._changed_s:  # it says nothing about this path
            self._rate.acknowledged(newest, size, now_s, 0.0)
            self._round_end = self._rate.delivered
            return
        if held_s is not None:
            hold_s = newest.sent_s - first_s + held_s
            self._hold.add(now_s, min(hold_s, _HOLD_MOST_S), now_s - _HOLD_WINDOW_S)
            self._measure_rtt(max(now_s - newest.sent_s - held_s, _LEAST_RTT_S), now_s)
        sample = self._rate.acknowledged(newest, size, now_s, self.base_rtt_s)
        if self.rtt_s is None:  # it may be of what was given up before: nothing is known of the path yet
            return
        self._round_frames += frames
        self._reported_lost += lost
        self._note_loss(frames, lost)
        is_new_round = newest.delivered >= self._round_end
        if is_new_round:
            self._round += 1
            self._round_end = self._rate.delivered
        if sample is not None and (not sample.is_app_limited or sample.bytes_s > self.bytes_s):
            self._rates.add(self._round, sample.bytes_s, self._round - _RATE_ROUNDS)
            self._peaks.add(now_s, sample.bytes_s, now_s - _CAPACITY_WINDOW_S)
            self._recent.add(self._round, sample.bytes_s, self._round - _RECENT_ROUNDS)
            self._last_rate = sample.bytes_s
            if not sample.is_app_limited and 2 * newest.inflight >= self.window:
                self._capacities.add(now_s, sample.bytes_s, now_s - _CAPACITY_WINDOW_S)
        self._note_queue(now_s)
        self._adapt(size, newest, now_s)
        if lost:
            self._record_lost(lost, newest.sent_s, now_s)
        if is_new_round:
            self._end_round(sample, now_s)
        self._set_limits()

    def measure_first(self, flight: Flight, now_s: float, held_s: float) -> None:
        """Measure the first round trip by a part of a flight: the rest may be lost, and then nothing else does.

        Args:
            held_s: how long the reader held the report back.
        """
        if self.rtt_s is None and flight.is_under_way and flight.sent_s >= self._changed_s:
            self._measure_rtt(max(now_s - flight.sent_s - held_s, _LEAST_RTT_S), now_s)
            self._set_limits()

    def lost(self, flights: Iterable[Flight], now_s: float) -> None:
        """Take flights that are taken for lost; those not under way any more are ignored."""
        flights = [flight for flight in flights if self._remove(flight)]
        if not flights:
            return
        frames = sum(flight.frames for flight in flights)
        self._round_frames += frames
        self._note_loss(frames, frames)
        self._record_lost(frames, max(flight.sent_s for flight in flights), now_s)
        self._set_limits()

    def forget(self, flights: Iterable[Flight]) -> None:
        """Take flights off the account whose fate will not be known."""
        for flight in flights:
            self._remove(flight)

    def forget_before(self, sent_s: float) -> None:
        """Take flights off the account that left before ``sent_s``."""
        self.forget(list(takewhile(lambda flight: flight.sent_s < sent_s, self._flights)))

    def forget_all(self) -> None:
        """Take everything under way off the account."""
        self.forget(list(self._flights))

    def _remove(self, flight: Flight) -> bool:
        """Take a flight off the account; return whether it was on it."""
        was_under_way, flight.is_under_way = flight.is_under_way, False
        if was_under_way:
            del self._flights[flight]
            self.inflight -= flight.size
        return was_under_way

    def timed_out(self, now_s: float) -> None:
        """Start again with two frames: nothing that is under way was confirmed."""
        self.forget_all()
        self._signal(Signal.PATH_CHANGED, now_s)
        self.window = float(_LEAST_FRAMES * self._mtu)
        self._set_limits()

    def _note_loss(self, frames: int, lost: int) -> None:
        """Average the share of lost frames over about ``_LOSS_FRAMES``."""
        part = min(frames / _LOSS_FRAMES, 1.0)
        self.loss += (lost / max(frames, 1) - self.loss) * part

    def _record_lost(self, frames: int, sent_s: float, now_s: float) -> None:
        """Count lost frames, the last of which left at ``sent_s``."""
        if sent_s >= self._entered_s:
            self._lost_frames += frames
        if self._cubic is not None and sent_s > self._lost_until_s:
            self._lost_until_s = now_s  # one reduction for the losses of one round trip
            self._cubic.lost(now_s, _LEAST_FRAMES, self._half_window() / self._mtu)
            if self.state is State.COMPETITIVE:
                self.window = self._cubic.window * self._mtu

    def path_changed(self, now_s: float) -> None:
        """Start again: frames now take another path; what is under way stays counted."""
        self._signal(Signal.PATH_CHANGED, now_s)
        self._set_limits()

    def set_mtu(self, mtu: int) -> None:
        """Set the bytes of a full frame; the window in bytes stays."""
        self._mtu = mtu
        self.window = max(self.window, float(_LEAST_FRAMES * mtu))
        self._set_limits()

    def _measure_rtt(self, rtt_s: float, now_s: float) -> None:
        self.rtt_s = rtt_s if self.rtt_s is None else self.rtt_s + (rtt_s - self.rtt_s) / 8
        is_held = self.state in (State.COMPETITIVE, State.PROBE)  # the other flow hides the empty path
        self._base.add(now_s, rtt_s, float("-inf") if is_held else now_s - _BASE_WINDOW_S)
        self._standing.add(now_s, rtt_s, now_s - self.rtt_s / 2)
        self._highest.add(now_s, rtt_s, now_s - 4 * self.rtt_s)

    def _note_queue(self, now_s: float) -> None:
        """Signal an empty queue at once."""
        highest_s = self._highest.value(0.0) - self.base_rtt_s
        # the base may be that of a short frame: what a full one takes to leave is no queue
        # and the least window of a lone flow on a thin path is no queue of another one
        most_s = max(_WANTED_MOST_S, _LEAST_FRAMES * self._mtu / self._capacities.value(float("inf")))
        wanted_s = min(self._wanted_frames() / self._frames_s(), most_s) + 1 / self._frames_s()
        if self.queue_s <= max(_EMPTY_SHARE * highest_s, wanted_s, _STANDING_S / 2):
            self._empty_s = now_s
            self._signal(Signal.QUEUE_EMPTY, now_s)

    def _frames_s(self) -> float:
        return max(self.bytes_s / self._mtu, 1.0)

    def _wanted_frames(self) -> float:
        """Return how many frames this flow keeps in the queue."""
        return max(_LEAST_QUEUE, _QUEUE_SHARE * sqrt(self._frames_s()))

    def _adapt(self, size: int, newest: Flight, now_s: float) -> None:
        """Change the window by what one acknowledgement allows."""
        # RFC 9002, section 7.8: an underused window does not grow
        may_grow = not newest.is_app_limited and (self.state is State.STARTUP or 2 * newest.inflight >= self.window)
        if self.state is State.STARTUP:
            self.window += size if may_grow else 0
            if self.queue_s >= min(max(self.base_rtt_s / 8, _ETA_S[0]), _ETA_S[1]):
                self._signal(Signal.PATH_FULL, now_s)
        elif self.state is State.DELAY:
            self._follow_delay(size, may_grow=may_grow)
            self._drain()
        elif self.state is State.COMPETITIVE and self._cubic is not None:
            if may_grow:
                self._cubic.acknowledged(size / self._mtu, now_s, self.rtt_s or FIRST_RTT_S)
            if now_s < self._claims_until_s:
                self._cubic.raise_to(self._half_window() / self._mtu)
            self.window = self._cubic.window * self._mtu
            if now_s >= self._probe_at_s:
                self._signal(Signal.PROBE_DUE, now_s)
        elif self.state is State.PROBE:
            drained_s = self._highest.value(0.0) + 2 * self.base_rtt_s
            if now_s - self._probe_begun_s > drained_s:
                self._end_probe(now_s)

    def _follow_delay(self, size: int, *, may_grow: bool) -> None:
        """Move towards the rate ``wanted frames / queueing delay``; Copa, section 2.1."""
        wanted = self._wanted_frames()
        rate = self.window / self._standing_s
        is_below = rate * self.queue_s <= wanted * self._mtu
        if is_below and not may_grow:
            return
        if is_below != (self._direction >= 0):  # Copa resets the velocity when the direction changes
            self._velocity, self._same, self._direction = 1.0, 0, 1 if is_below else -1
        step = min(self._velocity * wanted * self._mtu, self.window / 2) * size / self.window
        least = float(_LEAST_FRAMES * self._mtu)
        if is_below:  # of few frames, two more in a round trip would overflow a short FIFO
            self.window += min(step, self._velocity * _GROWTH_SHARE * size)
        else:
            kept = min(_FULL_SHARE * self._last_rate * self._empty_path_s, self.window)  # less would idle the path
            self.window = max(self.window - step, kept, least)

    def _end_round(self, sample: RateSample | None, now_s: float) -> None:
        """Decide what is decided once each round trip."""
        delivered = self._rate.delivered - self._round_delivered
        frames = self._round_frames
        is_lossy = frames >= _HEAVY_FRAMES and self._lost_frames > _SHRUNK_LOSS * frames
        self.lossy_rounds = self.lossy_rounds + 1 if is_lossy and self.state is State.COMPETITIVE else 0
        if frames >= _HEAVY_FRAMES and self._lost_frames > _HEAVY_LOSS * frames and self.state is not State.COMPETITIVE:
            self._signal(Signal.PATH_FULL, now_s)
            self.window = max(min(self.window, _AFTER_HEAVY * delivered), float(_LEAST_FRAMES * self._mtu))
            self._velocity, self._same = 1.0, 0
        elif self.state is State.STARTUP:
            self._note_growth(sample, now_s)
        elif self.state is State.DELAY:
            self._turn_velocity()
            patience_s = min(max(_STANDING_BASES * self.base_rtt_s, _STANDING_LEAST_S), _STANDING_MOST_S)
            if self.queue_s < _FALLING_SHARE * (self._highest.value(0.0) - self.base_rtt_s):
                self._empty_s = max(self._empty_s, now_s - patience_s / 2)  # it falls: its end may be near
            if now_s - self._empty_s > patience_s and self.queue_s > _STANDING_S:
                self._signal(Signal.QUEUE_STANDS, now_s)
            elif self._cubic is not None:
                self._try_alone(sample, now_s)
        elif self.lossy_rounds >= (_COLLAPSED_ROUNDS if self._has_collapsed() else _SHRUNK_ROUNDS):
            self._shrink(delivered * self._arrived, now_s)
        elif self.state is State.COMPETITIVE:
            is_full = self._was_alone and self._last_rate > _FULL_SHARE * self._capacity
            self._full_rounds = self._full_rounds + 1 if is_full else 0
            if self._full_rounds >= _FULL_ROUNDS:  # the other flow has little of the path: is it still there?
                self._full_rounds = 0
                self._signal(Signal.PROBE_DUE, now_s)
        self._round_delivered, self._lost_frames, self._round_frames = self._rate.delivered, 0, 0
        self._reported_lost = 0
        self._round_window, self._was_used = self.window, False

    @property
    def _arrived(self) -> float:
        """Return which share of the frames that the reports of this round resolved did arrive, 0 to 1."""
        return max(1 - self._reported_lost / max(self._round_frames, 1), 0.0)

    def _has_collapsed(self) -> bool:
        """Return whether next to nothing of the capacity is left."""
        return self._recent.value(0.0) * self._arrived < _COLLAPSED_SHARE * self._capacity

    def _shrink(self, delivered: float, now_s: float) -> None:
        """Forget the former capacity; ``delivered``: bytes that passed in the last round."""
        self._signal(Signal.PATH_SHRANK, now_s)
        for rates in self._rates, self._recent, self._peaks, self._capacities:
            rates.clear()
        self._cubic, self.lossy_rounds = None, 0
        self.window = max(_AFTER_HEAVY * delivered, float(_LEAST_FRAMES * self._mtu))

    def _try_alone(self, sample: RateSample | None, now_s: float) -> None:
        """Find out after a competition whether the other flow takes what this one has given up."""
        if now_s - self._entered_s > _TRIAL_S:
            self._cubic, self._probe_pause_s, self._shared_rate = None, _PROBE_S[0], 0.0
        elif sample is not None and not sample.is_app_limited:
            self._trial_rounds += 1
            is_less = self._recent.value(0.0) < _TRIAL_SHARE * self._shared_rate
            if is_less and self._trial_rounds >= _TRIAL_ROUNDS:
                self._signal(Signal.QUEUE_STANDS, now_s)

    def _drain(self) -> None:
        """Leave a long queue at once: less than what arrives in the round trip of the empty path."""
        wanted_s = self._wanted_frames() / self._frames_s()
        if self.queue_s > _DRAIN_QUEUES * wanted_s and self._last_rate:
            model = self._recent.value(0.0) * self._empty_path_s + self._wanted_frames() * self._mtu
            self.window = max(min(self.window, model), float(_LEAST_FRAMES * self._mtu))

    def _end_probe(self, now_s: float) -> None:
        """End a probe whose queue did not empty; where the round trip rests at another length, the path has changed."""
        standing_s = self._standing_s
        queue_s = self._probe_from_s - self.base_rtt_s
        has_fallen = self._probe_from_s - standing_s > _FALL_SHARE * queue_s
        rests = max(self._highest.value(0.0), self._probe_from_s) - standing_s < _STANDING_S
        if has_fallen or rests:
            self._base.clear()
            self._base.add(now_s, standing_s, now_s)
            self._signal(Signal.QUEUE_EMPTY, now_s)
        else:
            self._signal(Signal.PROBE_OVER, now_s)

    def _note_growth(self, sample: RateSample | None, now_s: float) -> None:
        """End the start-up when the delivery rate has not grown by a quarter for three rounds."""
        if sample is None or sample.is_app_limited or not self._was_used:
            return
        if self.bytes_s >= _FLAT_GROWTH * self._full_rate:
            self._full_rate, self._flat_rounds = self.bytes_s, 0
            return
        self._flat_rounds += 1
        if self._flat_rounds >= _FLAT_ROUNDS:
            self._signal(Signal.PATH_FULL, now_s)

    def _turn_velocity(self) -> None:
        """Double the velocity while the window keeps its direction; Copa, section 2.1."""
        direction = (self.window > self._round_window) - (self.window < self._round_window)
        self._same = self._same + 1 if direction == self._direction and direction else 0
        self._direction = direction
        self._velocity = 2 * self._velocity if self._same >= _SAME_DIRECTION else 1.0

    def _half_window(self) -> float:
        """Return the window that has half of the path, as long as its queue is now."""
        return self._capacity * self._standing_s / 2

    def _signal(self, signal: Signal, now_s: float) -> None:
        before, self.state = self.state, TRANSITIONS[self.state, signal]
        if signal is Signal.PATH_CHANGED:
            self._start()
            self._changed_s = self._entered_s = self._empty_s = now_s
        elif self.state is not before:
            self._enter(before, now_s)

    def _enter(self, before: State, now_s: float) -> None:
        """Set the window of a state that begins."""
        product = self.bytes_s * self._empty_path_s
        least = float(_LEAST_FRAMES * self._mtu)
        self._velocity, self._same, self._direction = 1.0, 0, 0
        alone_s = self._empty_s - self._entered_s  # of the state before
        self._empty_s = self._entered_s = now_s  # losses before this moment are of another window
        if self.state is State.DELAY:
            self._trial_rounds = 0
            if before is State.COMPETITIVE:
                self._shared_rate = max(self._shared_rate, self._recent.value(0.0))
                self._probe_begun_s = now_s
            if before is not State.COMPETITIVE:
                self.window = max(product, least)
            else:
                self.window = max(min(self.window, product), least)
        elif self.state is State.COMPETITIVE:
            if self._cubic is None:
                self._capacity = self._peaks.value(0.0)
                self._was_alone = alone_s >= _ALONE_S  # else the capacity is not known
                self._claims_until_s = now_s + _CLAIM_S if self._was_alone else 0.0
                self._cubic = Cubic(max(self.window, self._half_window()) / self._mtu, now_s)
            else:
                self._cubic.resume(now_s - self._probe_begun_s)
                self._probe_pause_s = min(2 * self._probe_pause_s, _PROBE_S[1])
            self.window = self._cubic.window * self._mtu
            self._probe_at_s = now_s + self._probe_pause_s
        elif self.state is State.PROBE:
            self._probe_begun_s, self._probe_from_s = now_s, self._standing_s
            self._shared_rate = max(self._shared_rate, self._recent.value(0.0))
            self.window = max(_PROBE_SHARE * product, least)
        self._round_window = self.window
