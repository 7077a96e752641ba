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
- Loss alone does not reduce the window, because radio loses frames. Loss of more than a tenth of a round does: the
  queue is then shorter than the one that the flow wants.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import sqrt
from typing import ClassVar, Final

from gdp.congestion.cubic import Cubic
from gdp.congestion.delivery_rate import DeliveryRate, Flight
from gdp.congestion.pacer import Pacer
from gdp.congestion.path_model import FIRST_RTT_S, PathModel
from gdp.congestion.states import TRANSITIONS, Signal, State
from gdp.requests import Backoff

_LEAST_FRAMES: Final = 2
_FIRST_FRAMES: Final = 32  # as Google's QUIC; RFC 6928 has 10
_LEAST_RTT_S: Final = 1e-5
_ETA_S: Final = (0.004, 0.016)  # RFC 9406, section 4.3
_FLAT_ROUNDS, _FLAT_GROWTH = 3, 1.25  # BBR: the pipe is full
_QUEUE_SHARE: Final = 0.1
_LEAST_QUEUE: Final = 2.0  # frames; Copa: 1/delta
_GROWTH_SHARE: Final = 0.125  # of the window, in a round trip
_SAME_DIRECTION: Final = 3  # rounds before the velocity doubles
_PACING_STARTUP, _PACING = 2.89, 1.2  # BBR: 2/ln 2 lets the window double each round trip
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
_PROBES: Final = Backoff(10.0, 60.0)
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
        limit: bytes that may be unconfirmed: those under way, and those that the reader has not reported yet.
        model: what is known of the path.
        rate: what is under way, and how fast it arrives.
        pace: when the next frame may leave.
        confirmed_sent_s: when the newest flight left that was confirmed.
        burst_frames: that leave at once, whatever the pace.
    """

    burst_frames: ClassVar[int] = 1

    def __init__(self, mtu: int) -> None:
        self.state = State.STARTUP
        self._mtu = mtu
        self.model = PathModel()
        self.rate = DeliveryRate()
        self.pace = Pacer(mtu)
        self._changed_s = 0.0
        self.confirmed_sent_s = float("-inf")
        self.window = float(_FIRST_FRAMES * mtu)
        self._start()
        self._set_limits()

    def _start(self) -> None:
        """Forget the path; the window begins no larger than it was, because another path may be as thin."""
        self.window = min(self.window, float(_FIRST_FRAMES * self._mtu))
        self.model.reset()
        self._round, self._round_end = 0, self.rate.delivered
        self._full_rate, self._flat_rounds = 0.0, 0
        self._velocity, self._direction, self._same, self._round_window = 1.0, 0, 0, self.window
        self._was_used = False
        self._lost_frames = self._round_frames = self._reported_lost = 0
        self._round_delivered = self.rate.delivered
        self._empty_s = self._entered_s = 0.0
        self._capacity = 0.0
        self._full_rounds = self.lossy_rounds = 0
        self._probe_from_s = 0.0
        self._cubic: Cubic | None = None
        self._lost_until_s = 0.0
        self._claims_until_s = 0.0
        self._probes = 1  # with the next one, since the path or the other flow was new
        self._probe_at_s = self._probe_begun_s = 0.0
        self._shared_rate, self._trial_rounds, self._was_alone = 0.0, 0, False

    def _set_limits(self) -> None:
        """Compute what each sender asks for: after every event, because frames are more frequent."""
        model, gain = self.model, _PACING_STARTUP if self.state is State.STARTUP else _PACING
        self.limit = self.window + model.bytes_s * model.hold_s
        rate = float("inf") if model.rtt_s is None else gain * self.window / model.standing_s
        self.pace.set_rate(rate, model.rtt_s or 0.0)

    def next_send_s(self, size: int) -> float | None:
        """Return when a frame of so many bytes may leave; None: not before something is confirmed or lost."""
        if self.rate.inflight and self.rate.inflight + size > self.limit:
            self.pace.is_paced = False
            return None
        return self.pace.due_s

    def sent(self, size: int, now_s: float, frames: int = 1) -> Flight:
        """Count and return a flight of so many bytes and frames, which leaves now."""
        flight = self.rate.sent(size, now_s, frames)
        self._was_used = self._was_used or self.rate.inflight + self._mtu > self.window
        self.pace.charge(size, now_s)
        return flight

    def app_limited(self) -> None:
        """Report that nothing waits, though a frame might leave if the window has space."""
        rate = self.rate
        if rate.inflight < self.limit:
            rate.limited_until = rate.delivered + (rate.inflight or 1)  # what is under way, and what follows it
            self.pace.is_paced = False

    def acknowledged(
        self, flights: Iterable[Flight], now_s: float, *, held_s: float | None = 0.0, lost: int = 0
    ) -> None:
        """Take an acknowledgement of one flight or many, in any order; those not under way any more are ignored.

        Args:
            held_s: how long the reader held it back; None: it gives no round trip.
            lost: how many of the frames did not arrive.
        """
        model, newest, first_s, size, frames = self.model, None, now_s, 0, 0
        for flight in flights:
            if not self.rate.remove(flight):
                continue
            size, frames = size + flight.size, frames + flight.frames
            first_s = flight.sent_s if flight.sent_s < first_s else first_s
            if newest is None or flight.sent_s > newest.sent_s:
                newest = flight
        if newest is None:
            return
        self.confirmed_sent_s = newest.sent_s if newest.sent_s > self.confirmed_sent_s else self.confirmed_sent_s
        if newest.sent_s < self._changed_s:  # it says nothing about this path
            self.rate.acknowledged(newest, size, now_s, 0.0)
            self._round_end = self.rate.delivered
            return
        if held_s is not None:
            model.add_hold(newest.sent_s - first_s + held_s, now_s)
            model.add_rtt(max(now_s - newest.sent_s - held_s, _LEAST_RTT_S), now_s)
        rate = self.rate.acknowledged(newest, size, now_s - (held_s or 0.0), model.base_rtt_s)
        if model.rtt_s is None:  # it may be of what was given up before: nothing is known of the path yet
            return
        self._round_frames += frames
        self._reported_lost += lost
        model.add_loss(frames, lost)
        is_new_round = newest.delivered >= self._round_end
        if is_new_round:
            self._round += 1
            self._round_end = self.rate.delivered
        if rate is not None and (not newest.is_app_limited or rate > model.bytes_s):
            is_full = not newest.is_app_limited and 2 * newest.inflight >= self.window
            model.add_rate(rate, self._round, now_s, is_full=is_full)
        self._note_queue(now_s)
        self._adapt(size, newest, now_s)
        if lost:
            self._record_lost(lost, newest.sent_s, now_s)
        if is_new_round:
            self._end_round(now_s, is_used=rate is not None and not newest.is_app_limited)
        self._set_limits()

    def measure_first(self, flight: Flight, now_s: float, held_s: float) -> None:
        """Measure the first round trip by a part of a flight: the rest may be lost, and then nothing else does.

        Args:
            held_s: how long the reader held the report back.
        """
        if self.model.rtt_s is None and flight.is_under_way and flight.sent_s >= self._changed_s:
            self.model.add_rtt(max(now_s - flight.sent_s - held_s, _LEAST_RTT_S), now_s)
            self._set_limits()

    def lost(self, flights: Iterable[Flight], now_s: float) -> None:
        """Take flights that are taken for lost; those not under way any more are ignored."""
        flights = [flight for flight in flights if self.rate.remove(flight)]
        if not flights:
            return
        frames = sum(flight.frames for flight in flights)
        self._round_frames += frames
        self.model.add_loss(frames, frames)
        self._record_lost(frames, max(flight.sent_s for flight in flights), now_s)
        self._set_limits()

    def timed_out(self, now_s: float) -> None:
        """Start again with two frames: nothing that is under way was confirmed."""
        self.rate.forget_before()
        self._signal(Signal.PATH_CHANGED, now_s)
        self.window = float(_LEAST_FRAMES * self._mtu)
        self._set_limits()

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
        self._mtu = self.pace.mtu = mtu
        self.window = max(self.window, float(_LEAST_FRAMES * mtu))
        self._set_limits()

    def _note_queue(self, now_s: float) -> None:
        """Signal an empty queue at once."""
        model = self.model
        if model.queue_s <= _STANDING_S / 2 or model.queue_s <= self._no_queue_s():
            self._empty_s = now_s
            self._signal(Signal.QUEUE_EMPTY, now_s)

    def _no_queue_s(self) -> float:
        """Return up to which standing queue, in seconds, the path counts as empty."""
        # what a flow gets next to another one is less than the path carries: its few frames would seem to be the queue
        capacity = 0.0 if self._cubic is None else self._capacity
        model, frames_s = self.model, max(self.model.bytes_s / self._mtu, capacity / self._mtu, 1.0)
        # the base may be that of a short frame: what a full one takes to leave is no queue
        # and the least window of a lone flow on a thin path is no queue of another one
        most_s = max(_WANTED_MOST_S, _LEAST_FRAMES * self._mtu / (model.capacity_bytes_s or float("inf")))
        wanted_s = min(_wanted_frames(frames_s) / frames_s, most_s) + 1 / frames_s
        return max(_EMPTY_SHARE * (model.highest_s - model.base_rtt_s), wanted_s)

    def _adapt(self, size: int, newest: Flight, now_s: float) -> None:
        """Change the window by what one acknowledgement allows."""
        # RFC 9002, section 7.8: an underused window does not grow
        may_grow = not newest.is_app_limited and (self.state is State.STARTUP or 2 * newest.inflight >= self.window)
        if self.state is State.STARTUP:
            self.window += size if may_grow else 0
            queue_s = self.model.queue_s
            if queue_s >= _ETA_S[0] and queue_s >= min(self.model.base_rtt_s / 8, _ETA_S[1]):
                self._signal(Signal.PATH_FULL, now_s)
        elif self.state is State.DELAY:
            self._follow_delay(size, may_grow=may_grow)
            self._drain()
        elif self.state is State.COMPETITIVE and self._cubic is not None:
            if may_grow:
                self._cubic.acknowledged(size / self._mtu, now_s, self.model.rtt_s or FIRST_RTT_S)
            if now_s < self._claims_until_s:
                self._cubic.raise_to(self._half_window() / self._mtu)
            self.window = self._cubic.window * self._mtu
            if now_s >= self._probe_at_s:
                self._signal(Signal.PROBE_DUE, now_s)
        elif self.state is State.PROBE:
            drained_s = self.model.highest_s + 2 * self.model.base_rtt_s
            if now_s - self._probe_begun_s > drained_s:
                self._end_probe(now_s)

    def _follow_delay(self, size: int, *, may_grow: bool) -> None:
        """Move towards the rate ``wanted frames / queueing delay``; Copa, section 2.1."""
        model, wanted = self.model, _wanted_frames(max(self.model.bytes_s / self._mtu, 1.0))
        rate = self.window / model.standing_s
        is_below = rate * model.queue_s <= wanted * self._mtu
        if is_below and not may_grow:
            return
        if is_below != (self._direction >= 0):  # Copa resets the velocity when the direction changes
            self._velocity, self._same, self._direction = 1.0, 0, 1 if is_below else -1
        step = min(self._velocity * wanted * self._mtu, self.window / 2) * size / self.window
        least = float(_LEAST_FRAMES * self._mtu)
        if is_below:  # of few frames, two more in a round trip would overflow a short FIFO
            self.window += min(step, self._velocity * _GROWTH_SHARE * size)
        else:
            kept = min(_FULL_SHARE * model.last_bytes_s * model.empty_path_s, self.window)  # less would idle the path
            self.window = max(self.window - step, kept, least)

    def _end_round(self, now_s: float, *, is_used: bool) -> None:
        """Decide what is decided once each round trip; ``is_used``: a rate was measured while more waited."""
        delivered = self.rate.delivered - self._round_delivered
        frames = self._round_frames
        is_lossy = frames >= _HEAVY_FRAMES and self._lost_frames > _SHRUNK_LOSS * frames
        self.lossy_rounds = self.lossy_rounds + 1 if is_lossy and self.state is State.COMPETITIVE else 0
        if frames >= _HEAVY_FRAMES and self._lost_frames > _HEAVY_LOSS * frames and self.state is not State.COMPETITIVE:
            self._signal(Signal.PATH_FULL, now_s)
            self.window = max(min(self.window, _AFTER_HEAVY * delivered), float(_LEAST_FRAMES * self._mtu))
            self._velocity, self._same = 1.0, 0
        elif self.state is State.STARTUP:
            if is_used and self._was_used:
                self._note_growth(now_s)
        elif self.state is State.DELAY:
            self._turn_velocity()
            patience_s = min(max(_STANDING_BASES * self.model.base_rtt_s, _STANDING_LEAST_S), _STANDING_MOST_S)
            if self.model.queue_s < _FALLING_SHARE * (self.model.highest_s - self.model.base_rtt_s):
                self._empty_s = max(self._empty_s, now_s - patience_s / 2)  # it falls: its end may be near
            if now_s - self._empty_s > patience_s and self.model.queue_s > _STANDING_S:
                self._signal(Signal.QUEUE_STANDS, now_s)
            elif self._cubic is not None:
                self._try_alone(now_s, is_used=is_used)
        elif self.lossy_rounds >= (_COLLAPSED_ROUNDS if self._has_collapsed() else _SHRUNK_ROUNDS):
            self._shrink(delivered * self._arrived, now_s)
        elif self.state is State.COMPETITIVE:
            is_full = self._was_alone and self.model.last_bytes_s > _FULL_SHARE * self._capacity
            self._full_rounds = self._full_rounds + 1 if is_full else 0
            if self._full_rounds >= _FULL_ROUNDS:  # the other flow has little of the path: is it still there?
                self._full_rounds = 0
                self._signal(Signal.PROBE_DUE, now_s)
        self._round_delivered, self._lost_frames, self._round_frames = self.rate.delivered, 0, 0
        self._reported_lost = 0
        self._round_window, self._was_used = self.window, False

    @property
    def _arrived(self) -> float:
        """Return which share of the frames that the reports of this round resolved did arrive, 0 to 1."""
        return max(1 - self._reported_lost / max(self._round_frames, 1), 0.0)

    def _has_collapsed(self) -> bool:
        """Return whether next to nothing of the capacity is left."""
        return self.model.recent_bytes_s * self._arrived < _COLLAPSED_SHARE * self._capacity

    def _shrink(self, delivered: float, now_s: float) -> None:
        """Forget the former capacity; ``delivered``: bytes that passed in the last round."""
        self._signal(Signal.PATH_SHRANK, now_s)
        self.model.forget_rates()
        self._cubic, self.lossy_rounds = None, 0
        self.window = max(_AFTER_HEAVY * delivered, float(_LEAST_FRAMES * self._mtu))

    def _try_alone(self, now_s: float, *, is_used: bool) -> None:
        """Find out after a competition whether the other flow takes what this one has given up."""
        if now_s - self._entered_s > _TRIAL_S:
            self._cubic, self._probes, self._shared_rate = None, 1, 0.0
        elif is_used:
            self._trial_rounds += 1
            is_less = self.model.recent_bytes_s < _TRIAL_SHARE * self._shared_rate
            if is_less and self._trial_rounds >= _TRIAL_ROUNDS:
                self._signal(Signal.QUEUE_STANDS, now_s)

    def _drain(self) -> None:
        """Leave a long queue at once: less than what arrives in the round trip of the empty path."""
        model, frames_s = self.model, max(self.model.bytes_s / self._mtu, 1.0)
        wanted = _wanted_frames(frames_s)
        if model.queue_s > _DRAIN_QUEUES * (wanted / frames_s) and model.last_bytes_s:
            product = model.recent_bytes_s * model.empty_path_s + wanted * self._mtu
            self.window = max(min(self.window, product), float(_LEAST_FRAMES * self._mtu))

    def _end_probe(self, now_s: float) -> None:
        """End a probe whose queue did not empty; where the round trip rests at another length, the path has changed."""
        standing_s = self.model.standing_s
        queue_s = self._probe_from_s - self.model.base_rtt_s
        has_fallen = self._probe_from_s - standing_s > _FALL_SHARE * queue_s
        rests = max(self.model.highest_s, self._probe_from_s) - standing_s < _STANDING_S
        if has_fallen or rests:
            self.model.rest_at_standing(now_s)
            self._signal(Signal.QUEUE_EMPTY, now_s)
        else:
            self._signal(Signal.PROBE_OVER, now_s)

    def _note_growth(self, now_s: float) -> None:
        """End the start-up when the delivery rate has not grown by a quarter for three rounds."""
        if self.model.bytes_s >= _FLAT_GROWTH * self._full_rate:
            self._full_rate, self._flat_rounds = self.model.bytes_s, 0
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
        return self._capacity * self.model.standing_s / 2

    def _signal(self, signal: Signal, now_s: float) -> None:
        before, self.state = self.state, TRANSITIONS[self.state, signal]
        self.model.is_hidden = self.state in (State.COMPETITIVE, State.PROBE)
        if signal is Signal.PATH_CHANGED:
            self._start()
            self._changed_s = self._entered_s = self._empty_s = now_s
        elif self.state is not before:
            self._enter(before, now_s)

    def _enter(self, before: State, now_s: float) -> None:
        """Set the window of a state that begins."""
        product = self.model.bytes_s * self.model.empty_path_s
        least = float(_LEAST_FRAMES * self._mtu)
        self._velocity, self._same, self._direction = 1.0, 0, 0
        alone_s = self._empty_s - self._entered_s  # of the state before
        self._empty_s = self._entered_s = now_s  # losses before this moment are of another window
        if self.state is State.DELAY:
            self._trial_rounds = 0
            if before is State.COMPETITIVE:
                self._shared_rate = max(self._shared_rate, self.model.recent_bytes_s)
                self._probe_begun_s = now_s
            if before is not State.COMPETITIVE:
                self.window = max(product, least)
            else:
                self.window = max(min(self.window, product), least)
        elif self.state is State.COMPETITIVE:
            if self._cubic is None:
                self._capacity = self.model.peak_bytes_s
                self._was_alone = alone_s >= _ALONE_S  # else the capacity is not known
                self._claims_until_s = now_s + _CLAIM_S if self._was_alone else 0.0
                self._cubic = Cubic(max(self.window, self._half_window()) / self._mtu, now_s)
            else:
                self._cubic.resume(now_s - self._probe_begun_s)
                self._probes += 1
            self.window = self._cubic.window * self._mtu
            self._probe_at_s = now_s + _PROBES.pause_s(self._probes)
        elif self.state is State.PROBE:
            self._probe_begun_s, self._probe_from_s = now_s, self.model.standing_s
            self._shared_rate = max(self._shared_rate, self.model.recent_bytes_s)
            self.window = max(_PROBE_SHARE * product, least)
        self._round_window = self.window


def _wanted_frames(frames_s: float) -> float:
    """Return how many frames a flow of so many a second keeps in the queue."""
    return max(_LEAST_QUEUE, _QUEUE_SHARE * sqrt(frames_s))
