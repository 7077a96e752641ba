"""Paths to reader nodes: what may leave for each of them now, whatever the topic.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). One congestion controller (``gdp/congestion``) for each reader
node is shared by all publishers of a participant that this node reads. A frame to several readers counts on the path of
each. On a topic it leaves when all of them permit it, so the slowest reader governs; of requests the fastest path
governs. A reader that confirms nothing for a timeout governs no others until a round trip to it is measured again;
alone, it gets two frames each timeout. When a reader node restarts, its path begins again, and frames to its former
incarnation do not count. What leaves at the priority `background` has paths of its own, whose controllers yield to all
others.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from typing import Final

from gdp.congestion.controller import PathController
from gdp.congestion.delivery_rate import Flight
from gdp.congestion.path_model import FIRST_RTT_S
from gdp.congestion.states import State
from gdp.intervals import FORGET_S, NEVER_S, PACE_S
from gdp.limits import MTU_MIN_BYTES, REPORT_DELAY_S
from gdp.requests import Backoff

FLIGHT_FRAMES: Final = 16  # of those that leave at once and are confirmed together, at most
BURST_S: Final = 0.001  # frames of this time leave at once: a timer for each frame would cost more than it smooths
_TIMEOUTS: Final = Backoff(0.3, 4.0)
_TIMEOUT_TRIPS: Final = 4.0
_DOUBLINGS_MAX: Final = 3
_PROBE_TRIPS, _PROBE_LEAST_S = 2.0, 0.1
_LATE_TRIPS, _LATE_LEAST_S = 4.0, 0.1  # RFC 8985, section 6.2; reports of one topic may come so much after another's
_BEHIND_S: Final = 0.1  # a reader reports 20 ms after a frame came
_BEHIND_REPORTS: Final = 2
_URGENT_SHARE: Final = 1.5  # of the window: urgent frames find space where the others have filled it
_URGENT_FRAMES: Final = 8
_MESSAGE_FRAMES: Final = 100  # of a large message, one loss among which costs a round trip
_UNLIMITED: Final = 1 << 30


class ReaderPath:
    """Path to one reader node.

    Attributes:
        mtu: bytes of a full frame.
        controller: its congestion controller.
        sent_bytes: of all frames so far.
        may_probe: one frame may leave whatever the window: what a report of it shows as lost makes space.
        is_silent: nothing was confirmed for a timeout, though something is under way.
        is_behind: frames wait in the reader's own socket, because its program is slow; the path is not the reason.
        heard_s: monotonic second of the last report.
    """

    def __init__(self, mtu: int, now_s: float, new: Callable[[int], PathController] = PathController) -> None:
        self.mtu = mtu
        self._new = new
        self.sent_bytes = 0
        self.heard_s = -NEVER_S
        self.controller = new(mtu)
        self.restart(now_s)

    def restart(self, now_s: float) -> None:
        """Begin without knowledge; what is under way will not be confirmed, because its reader node has restarted."""
        self.controller.rate.forget_before()
        self.controller = self._new(self.mtu)
        self.is_silent = self.is_behind = self.may_probe = self._has_probed = self._awaits_tree = False
        self._late_reports = 0  # in a row
        self._hops: int | None = None
        self._confirmed_s = now_s
        self._answered_s = now_s  # as _confirmed_s, but a timeout does not change it
        self._trip_s = 0.0  # the last one measured; a timeout forgets the controller's
        self._timeouts = 0  # since a round trip was measured

    def allowance(self, now_s: float, *, urgent: bool = False) -> int:
        """Return how many bytes may leave now; 0: none."""
        controller, mtu = self.controller, self.mtu
        if self.may_probe:
            return mtu
        free = int(controller.limit) - controller.rate.inflight
        if urgent:
            extra = max((_URGENT_SHARE - 1) * controller.window, _URGENT_FRAMES * mtu)
            return max(free + int(extra), 0)
        if free <= 0 and controller.next_send_s(mtu) is None:
            return 0
        next_s = controller.pace.due_s
        if next_s > now_s + BURST_S:
            controller.pace.is_paced = True
            return 0
        free = free if free > mtu else mtu  # an empty path carries a frame, whatever its window
        pace = controller.pace.bytes_s
        if pace >= _UNLIMITED:
            return free
        if next_s < now_s - BURST_S:
            burst_s = max(controller.pace.credit_s, BURST_S) if controller.pace.is_paced else BURST_S
            next_s = next_s if next_s > now_s - burst_s else now_s - burst_s
        paced = int((now_s + BURST_S - next_s) * pace) + controller.burst_frames * mtu
        paced = paced if paced > mtu else mtu
        return free if free < paced else paced

    def next_send_s(self) -> float:
        """Return when the next frame may leave; infinity: not before something is confirmed."""
        if self.may_probe:
            return 0.0
        next_s = self.controller.next_send_s(self.mtu)
        return NEVER_S if next_s is None else next_s

    def sent(self, size: int, frames: int, now_s: float) -> Flight:
        """Count frames that leave at once; return the flight as which they are confirmed."""
        if not self.controller.rate.inflight:
            self._confirmed_s = now_s
            self._answered_s = self._answered_s if self._timeouts else now_s
        self.sent_bytes += size
        self.may_probe = False
        return self.controller.sent(size, now_s, frames)

    def acknowledged(self, flights: Iterable[Flight], lost: int, held_s: float | None, now_s: float) -> None:
        """Take what a report confirms; ``lost`` of these frames did not arrive.

        Args:
            held_s: how long the reader held the report back; None: it gives no round trip.
        """
        before = self.controller.rate.inflight
        self.controller.acknowledged(flights, now_s, held_s=held_s, lost=lost)
        if self.controller.rate.inflight < before:
            self._confirmed_s, self._has_probed = now_s, False
            if self.controller.model.rtt_s is not None:  # not one of before a timeout
                self._answered_s, self._trip_s, self._timeouts = now_s, self.controller.model.rtt_s, 0

    def handle_part(self, flight: Flight, held_s: float | None, now_s: float) -> None:
        """Note that a part of a flight came, which delays the timeout; ``held_s`` as in ``acknowledged``."""
        self._confirmed_s = now_s
        if held_s is not None:
            self.controller.measure_first(flight, now_s, held_s)

    def handle_held(self, held_s: float) -> None:
        """Note how long the newest frame of a report had waited at the reader when it left."""
        self._late_reports = self._late_reports + 1 if held_s > _BEHIND_S else 0
        self.is_behind = self._late_reports >= _BEHIND_REPORTS

    def handle_heard(self, now_s: float) -> None:
        """Note that the reader is alive; what left during a silence and is not confirmed now was lost."""
        self.heard_s = now_s
        if self.is_silent:
            self.is_silent = False
            self.controller.rate.forget_before()

    @property
    def trip_s(self) -> float:
        """Return the smoothed round trip, that of before a timeout if none was measured since; 0: none yet."""
        return self.controller.model.rtt_s or self._trip_s

    @property
    def governs_others(self) -> bool:
        """Return whether other readers wait for this one: a round trip was measured since its last silence."""
        return not self.is_silent and (not self._timeouts or self.controller.model.rtt_s is not None)

    @property
    def stall_s(self) -> float:
        """Return how long a path that carries something may confirm nothing."""
        return _PROBE_TRIPS * (self.trip_s or FIRST_RTT_S) + REPORT_DELAY_S

    def has_stalled(self, now_s: float) -> bool:
        """Return whether nothing under way was confirmed for two round trips and a report's delay."""
        return self.is_silent or (self.controller.rate.inflight > 0 and now_s - self._confirmed_s > self.stall_s)

    def arrival_s(self, size: int) -> float:
        """Return how long so many bytes take to be confirmed, while no queue stands; a loss takes a round trip more.

        Window and smoothed round trip change with each queue that other paths share, so the order would follow them.
        """
        model = self.controller.model
        trips = 1 + min(model.loss * _MESSAGE_FRAMES, 1.0)
        return size / max(model.capacity_bytes_s or 0.0, self.allowed_bytes_s) + trips * model.base_rtt_s

    def excess_s(self, size: int) -> float:
        """Return for how long bytes leave that do not fit the window now."""
        excess = size - max(self.controller.limit - self.controller.rate.inflight, 0.0)
        return max(excess, 0.0) / self.allowed_bytes_s

    @property
    def allowed_bytes_s(self) -> float:
        """Return the bytes a second that the window permits."""
        return self.controller.window / (self.controller.model.rtt_s or FIRST_RTT_S)

    def carries(self, size: int, within_s: float) -> bool:
        """Return whether so many bytes may leave within a time, as far as the path was measured."""
        excess_s = self.excess_s(size)
        return not excess_s or (excess_s <= within_s and self.controller.state is not State.STARTUP)

    def patience_s(self, now_s: float) -> float:
        """Return how long an answer may take: a round trip, or as long as nothing under way was confirmed."""
        is_waiting = self._timeouts > 0 or self.controller.rate.inflight > 0
        return max(self._trip_s, now_s - self._answered_s if is_waiting else 0.0)

    def handle_hops(self, hops: int, now_s: float) -> None:
        """Note over how many hops a report came; another count means another path."""
        if self._hops is not None and hops != self._hops:
            self.controller.path_changed(now_s)
        self._hops = hops

    def attachment_changed(self, now_s: float) -> None:
        """Start again: frames leave by another switch, which no tree reaches yet."""
        self.controller.path_changed(now_s)
        self._awaits_tree = True

    def tree_stands(self, mtu: int) -> None:
        """Note that a tree leads there, with the bytes of a full frame; after a silence or a move, none did before."""
        if self._awaits_tree or not self.governs_others:
            self.controller.rate.forget_before()
            self._timeouts, self._awaits_tree = min(self._timeouts, 1), False
        if mtu != self.mtu:
            self.mtu = mtu
            self.controller.set_mtu(mtu)

    def handle_timer(self, now_s: float) -> None:
        """Start again if nothing was confirmed for too long; forget what was not, while other frames were.

        Else the lost end of one topic's message would fill the window for ever: what confirms it is a later frame of
        that topic, which may not leave, and frames of other topics keep the path from a timeout. Timeouts that follow
        each other double (RFC 6298, section 5.5): shorter than the round trip, they would never let one be measured.
        Before a timeout one frame may leave (RFC 8985, section 7): the last ones of a full window may be lost.
        """
        if not self.controller.rate.inflight:
            return
        timeout_s = _TIMEOUTS.pause_s(min(self._timeouts, _DOUBLINGS_MAX) + 1, _TIMEOUT_TRIPS * self._trip_s)
        if now_s - self._confirmed_s >= timeout_s:
            self._timeouts += 1
            self.controller.timed_out(now_s)
            self.is_silent, self._confirmed_s, self.may_probe, self._has_probed = True, now_s, False, False
        else:
            if not self._has_probed and now_s - self._confirmed_s >= max(_PROBE_TRIPS * self._trip_s, _PROBE_LEAST_S):
                self.may_probe = self._has_probed = True
            late_s = max(self._trip_s / _LATE_TRIPS, _LATE_LEAST_S)
            self.controller.rate.forget_before(self.controller.confirmed_sent_s - late_s)
            inflight = self.controller.rate.inflight
            self.controller.rate.forget_before(self._confirmed_s - timeout_s)
            self._timeouts += self.controller.rate.inflight < inflight

    def is_unused(self, now_s: float) -> bool:
        """Return whether nothing was confirmed for so long that the path need not be remembered."""
        return not self.controller.rate.inflight and now_s - self._confirmed_s > FORGET_S


class ReaderPaths:
    """Paths of one participant, by the name of the reader node.

    Args:
        new: makes the controller of a path with so many bytes of a full frame.

    Attributes:
        due_s: monotonic second of the next ``handle_timer``; infinity: none.
        leaving: flights that are counted, and perhaps not sealed yet.
        changes: count of paths that came and went.
    """

    def __init__(self, new: Callable[[int], PathController] = PathController) -> None:
        self._new = new
        self._paths: dict[bytes, ReaderPath] = {}
        self._started: dict[bytes, int] = {}  # when the newest incarnation of a reader node started
        self.due_s = NEVER_S
        self.leaving: list[Flight] = []
        self.changes = 0
        self._mtu = MTU_MIN_BYTES  # of new paths

    def __len__(self) -> int:
        return len(self._paths)

    def path(self, reader: bytes, now_s: float) -> ReaderPath:
        """Return the path to a reader node; a new one begins without knowledge."""
        if reader not in self._paths:
            self._paths[reader] = ReaderPath(self._mtu, now_s, self._new)
            self.changes += 1
        if self.due_s == NEVER_S:
            self.due_s = now_s + PACE_S
        return self._paths[reader]

    def charge_others(self, size: int, readers: Container[bytes], now_s: float) -> None:
        """Delay what follows to all but these readers by the time that so many bytes take."""
        for reader, path in self._paths.items():
            if reader not in readers:
                path.controller.pace.charge_other(size, now_s)

    def get(self, reader: bytes) -> ReaderPath | None:
        """Return the path to a reader node, or None."""
        return self._paths.get(reader)

    def note_incarnation(self, reader: bytes, started: int, now_s: float) -> None:
        """Note when an incarnation of a reader node started, as it says; the path to a new one begins again."""
        known = self._started.get(reader, 0)
        if started <= known:
            return
        self._started[reader] = started
        if known and (path := self._paths.get(reader)) is not None:
            path.restart(now_s)

    def is_behind(self, reader: bytes) -> bool:
        """Return whether a reader's own program is too slow for what arrives there."""
        path = self._paths.get(reader)
        return path is not None and path.is_behind

    def is_former(self, reader: bytes, started: int) -> bool:
        """Return whether a reader node has started again since; 0: not known when it started."""
        return 0 < started < self._started.get(reader, 0)

    def tree_stands(self, readers: Iterable[bytes], mtu: int) -> None:
        """Note that a tree leads to some readers, with the bytes of a full frame, which also new paths begin with."""
        self._mtu = mtu
        for reader in readers:
            if reader in self._paths:
                self._paths[reader].tree_stands(mtu)

    def governing(self, readers: Iterable[bytes], now_s: float) -> list[ReaderPath]:
        """Return the paths that govern what leaves for these readers: one of those that do not, only if none does."""
        paths = [self._paths.get(reader) or self.path(reader, now_s) for reader in readers]
        if len(paths) < 2:
            return paths
        return [path for path in paths if path.governs_others] or paths[:1]

    def fastest(self, readers: Iterable[bytes], now_s: float) -> list[bytes]:
        """Return the one of these readers whose path is the shortest, and has not stalled; none of none."""
        paths = [(reader, self._paths.get(reader)) for reader in readers]
        known = [(path.has_stalled(now_s), path.arrival_s(0), reader) for reader, path in paths if path is not None]
        return [min(known)[2]] if known else [reader for reader, _ in paths[:1]]

    def fastest_first(self, readers: Iterable[bytes], size: int, now_s: float) -> tuple[list[bytes], bool]:
        """Return readers in the order in which ``size`` bytes would reach them, and whether one copy may go to all.

        It may where each path can carry it as fast as the fastest one does.
        """
        paths = {reader: self.path(reader, now_s) for reader in readers}
        order = sorted(paths, key=lambda reader: (paths[reader].has_stalled(now_s), paths[reader].arrival_s(size)))
        within_s = paths[order[0]].arrival_s(size) if order else 0.0
        return order, all(path.carries(size, within_s) for path in paths.values())

    def attachment_changed(self, now_s: float) -> None:
        """Start every path again, as ``ReaderPath.attachment_changed``."""
        for path in self._paths.values():
            path.attachment_changed(now_s)

    def frames_sent(self, now_s: float) -> None:
        """Note that what was counted since the last call leaves now."""
        for flight in self.leaving:
            flight.sent_s = now_s
        self.leaving = []

    def handle_timer(self, now_s: float) -> bool:
        """Let silent paths start again, and forget unused ones; return whether any may carry more now."""
        if now_s < self.due_s:
            return False
        may_more, self.due_s = False, NEVER_S
        for reader, path in list(self._paths.items()):
            inflight, was_silent = path.controller.rate.inflight, path.is_silent
            path.handle_timer(now_s)
            may_more |= path.controller.rate.inflight < inflight or path.may_probe or path.is_silent is not was_silent
            if path.controller.rate.inflight:
                self.due_s = now_s + PACE_S
            elif path.is_unused(now_s):
                may_more |= path.is_silent
                del self._paths[reader]
                self._started.pop(reader, None)
                self.changes += 1
        return may_more
