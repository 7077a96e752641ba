"""Send scheduler of a participant: the order in which its publishers send, and when.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Urgent publishers come first, in the order of their
priorities. The others share what their paths permit by deficit round robin, by priority and weight. A publisher that
had nothing to send has its first round before those that wait, so that no image delays a scan. Those at the priority
``background`` come last, and their paths count the frames of all. A publisher with several
readers needs space on all their paths at once. When its turn has come and there is none, publishers behind it leave
these paths alone for up to ``_RESERVED_S``; else they would take each space as it appears. Sources: Linux
``sch_prio``; M. Shreedhar and G. Varghese, Efficient Fair Queuing Using Deficit Round Robin, SIGCOMM 1995; RFC 8290,
section 4 (new and old queues).
"""

from __future__ import annotations

from itertools import chain, islice
from typing import Final

from gdp.client.publisher import Publisher
from gdp.client.reader_path import ReaderPaths
from gdp.client.timer_queue import TimerQueue
from gdp.congestion.path_model import NOISE_S
from gdp.intervals import NEVER_S
from gdp.limits import MTU_MIN_BYTES

BYTES_AT_ONCE: Final = 160 << 10  # of ordinary frames, before any other publisher has its turn
BYTES_WITH_URGENT: Final = 64 << 10  # ... with an urgent topic, whose frames may have to wait for this amount
_QUANTUM_FRAMES: Final = 2  # of the publisher with the least share in each round, where the path is the limit
_RESERVED_S: Final = 0.25  # and for as long after that paths are not reserved, so that a slow reader stops no others


class SendScheduler:
    """Publishers with frames to send; urgent ones first, the others in turn.

    Args:
        timers: of the publishers; polling frames touches them.
        background: paths of what leaves when no others do; None: nothing does.

    Attributes:
        is_ready: some publisher waits, and the paths hold it back no longer.
        due_s: monotonic second at which a path permits more; infinity: nothing waits, or for a reader's report.
        uncounted: the only publisher, whose frames leave before they are counted; else None.
    """

    def __init__(self, timers: TimerQueue[Publisher], background: ReaderPaths | None = None) -> None:
        self._timers = timers
        self._background = background
        self._urgent: dict[Publisher, None] = {}
        self._new: dict[Publisher, None] = {}  # had nothing to send before
        self._ordinary: dict[Publisher, int] = {}  # with the bytes left of its round; the one whose turn it is first
        self._at_once = BYTES_AT_ONCE
        self._is_held = False  # the paths hold back all that wait
        self.is_ready = False
        self.due_s = NEVER_S
        self.uncounted: Publisher | None = None
        self._is_idle = False  # it had nothing more
        self._reserved_until_s = float("-inf")  # for the publisher whose turn it is
        self._reserving: Publisher | None = None

    def add(self, publisher: Publisher) -> None:
        """Note that a publisher may have frames; one that already waits for its turn keeps its position."""
        self._is_held, self.is_ready, self.due_s = False, True, NEVER_S
        if publisher.is_urgent:
            self._at_once = BYTES_WITH_URGENT
            self._urgent[publisher] = None
        elif publisher not in self._ordinary:
            self._new[publisher] = None

    def handle_report(self, publisher: Publisher, now_s: float) -> None:
        """Note that a reader reported: its publisher may have frames, and others may wait for the same path."""
        is_waiting = self._urgent or self._new or self._ordinary or self.uncounted is not None
        if is_waiting or publisher.has_work or publisher.governing_paths.allowance(now_s) <= 0:
            self.add(publisher)
        else:
            self.uncounted, self._is_idle = publisher, True
            self._timers.touched[publisher] = None

    def resume(self) -> None:
        """Note that paths may permit more than before."""
        self._hold(None)

    def poll_turn(self, now_s: float) -> list[list[bytes]]:
        """Return the frames that leave now, urgent and ordinary ones apart; an empty publisher leaves the queue."""
        if self._is_held and now_s < self.due_s:
            return []
        if self.uncounted is not None:
            self.count_sent()
        if not (self._urgent or self._new or self._ordinary):
            return []
        if not (self._urgent or (self._new and self._ordinary)) and len(self._new or self._ordinary) == 1:
            frames = self._poll_only(now_s)
            return [frames] if frames else []
        urgent, due_s = self._poll_urgent(now_s)
        if 0 < sum(map(len, urgent)) < self._at_once // 2:
            self._hold(None)
            return [urgent]  # it leaves now; the others' next chunk is sealed after that
        self._ordinary = {**dict.fromkeys(self._new, 0), **self._ordinary}
        self._new.clear()
        ordinary, ordinary_due_s = self._poll_ordinary(now_s)
        self._hold(None if urgent or ordinary else min(due_s, ordinary_due_s))
        return [frames for frames in (urgent, ordinary) if frames]

    def count_sent(self) -> None:
        """Count what the only publisher sent: after its frames have left, so that they need not wait for that."""
        publisher, self.uncounted = self.uncounted, None
        if publisher is not None:
            if publisher.sent_frames.leaving is not None:
                publisher.sent_frames.count()
            if self._is_idle:
                publisher.governing_paths.note_idle()

    def _poll_only(self, now_s: float) -> list[bytes]:
        """Return frames of the only publisher that waits, an ordinary one: it shares with no other."""
        (publisher,) = self._ordinary or self._new
        publisher.governing_paths.share = 1.0
        allowance = publisher.governing_paths.allowance(now_s)
        frames = publisher.poll_frames(now_s, allowance if allowance < self._at_once else self._at_once)
        self._charge(publisher, frames, now_s)
        self._timers.touched[publisher] = None
        self.uncounted, self._is_idle = publisher, allowance > 0 and not publisher.has_more
        self._new = {}
        if self._is_idle:
            self._ordinary, self._is_held, self.is_ready, self.due_s = {}, False, False, NEVER_S
            return frames
        self._ordinary = {publisher: 0}
        next_s = _or_never(publisher.governing_paths.next_send_s(now_s)) if allowance <= 0 else NEVER_S
        self._hold(None if frames else next_s)
        return frames

    def _hold(self, until_s: float | None) -> None:
        """Hold back what waits until a monotonic second; None: no longer."""
        is_waiting = bool(self._urgent or self._new or self._ordinary)
        self._is_held = is_waiting and until_s is not None
        self.is_ready = is_waiting and until_s is None
        self.due_s = NEVER_S if until_s is None or not is_waiting else until_s

    def _poll_urgent(self, now_s: float) -> tuple[list[bytes], float]:
        """Return urgent frames, and when a path permits more."""
        frames: list[bytes] = []
        due_s = NEVER_S
        for publisher in sorted(self._urgent, key=lambda each: each.options.rank):
            allowance = publisher.governing_paths.allowance(now_s)
            frames += self._poll(publisher, min(allowance, self._at_once), now_s)
            if allowance <= 0:
                due_s = min(due_s, _or_never(publisher.governing_paths.next_send_s(now_s)))
            elif not publisher.has_more:
                self._urgent.pop(publisher, None)
        return frames, due_s

    def _poll_ordinary(self, now_s: float) -> tuple[list[bytes], float]:
        """Return one round of ordinary frames, and when a path permits more."""
        frames: list[bytes] = []
        due_s, left = NEVER_S, self._at_once
        shares = [publisher.options.share for publisher in self._ordinary]
        total, least = sum(shares), min(shares, default=1)
        reserved = frozenset[bytes]()
        for publisher, left_of_round in sorted(self._ordinary.items(), key=lambda each: each[0].is_background):
            publisher.governing_paths.share = publisher.options.share / total
            allowance = publisher.governing_paths.allowance(now_s)
            is_reserved = bool(reserved) and any(name in publisher.matched.active for name in reserved)
            if allowance <= 0 or is_reserved:
                frames += self._poll(publisher, 0, now_s)
                due_s = min(
                    due_s,
                    self._reserved_until_s if is_reserved else _or_never(publisher.governing_paths.next_send_s(now_s)),
                )
                reserved = reserved or self._reserve(publisher, now_s)
                continue
            if publisher is self._reserving:
                self._reserving, self._reserved_until_s = None, float("-inf")
            is_shared = allowance < left and len(self._ordinary) > 1
            deficit = left_of_round
            if is_shared and deficit <= 0:
                deficit += _QUANTUM_FRAMES * publisher.options.share * (publisher.queue.mtu or MTU_MIN_BYTES) // least
            polled = self._poll(publisher, min(allowance, deficit if is_shared else left), now_s)
            size = sum(map(len, polled))
            frames += polled
            left -= size
            deficit = deficit - size if is_shared else 0
            if not publisher.has_more:
                self._ordinary.pop(publisher, None)
            elif deficit > 0:
                self._ordinary[publisher] = deficit  # its round goes on when the path permits
            else:
                self._ordinary.pop(publisher, None)
                self._ordinary[publisher] = deficit  # behind the others
            if left < self._at_once // 2:
                break
        return frames, due_s

    def _reserve(self, publisher: Publisher, now_s: float) -> frozenset[bytes]:
        """Reserve the paths of a publisher that has to wait for several; return its readers, or none."""
        is_its = publisher is self._reserving and now_s < self._reserved_until_s
        if (not is_its and now_s < self._reserved_until_s + _RESERVED_S) or publisher.governing_paths.is_limited(now_s):
            return frozenset()
        if (readers := publisher.governing_paths.awaited_readers()) and not is_its:
            self._reserving, self._reserved_until_s = publisher, now_s + _RESERVED_S
        return readers

    def _poll(self, publisher: Publisher, limit_bytes: int, now_s: float) -> list[bytes]:
        frames = publisher.poll_frames(now_s, limit_bytes)
        publisher.sent_frames.count()
        self._charge(publisher, frames, now_s)
        self._timers.touched[publisher] = None
        if limit_bytes > 0 and not publisher.has_more:
            live = (each for each in chain(self._ordinary, self._urgent, self._new) if not each.is_background)
            if len(list(islice(live, 2))) < 2:
                publisher.governing_paths.note_idle()  # the path could carry more than there is
        return frames

    def _charge(self, publisher: Publisher, frames: list[bytes], now_s: float) -> None:
        """Let what is to wait wait for the frames of others; its own count on their paths already."""
        if not frames or not self._background:
            return
        paths, may_wait = publisher.governing_paths, publisher.is_background
        base_rtt_s = paths.base_rtt_s  # below the noise of programs it has no uplink in common
        if may_wait or base_rtt_s is None or base_rtt_s >= NOISE_S:
            self._background.charge_others(sum(map(len, frames)), paths.names() if may_wait else (), now_s)


def _or_never(due_s: float | None) -> float:
    return NEVER_S if due_s is None else due_s
