"""Runtime of one node: a protocol core, a data plane, two clocks and the signals that end it.

I/O. One thread runs one loop: it waits for frames or for the core's next timer, calls the core, and sends the frames of
the core.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from gdp.due_queue import earliest
from gdp.intervals import LOOK_S, NEVER_S, UPKEEP_S
from gdp.limits import COST_DEFAULT
from gdp.ports.plane import HasFileno, Plane
from gdp.runtime.busy_poll import BusyPoll
from gdp.runtime.memory_tuning import tune_memory
from gdp.runtime.signals import handled_signals
from gdp.sansio import KeepaliveRun, NodeCore, ReceivedFrame, Timestamps

log = logging.getLogger(__name__)

DRAIN_MAX_S = 2.0  # a draining switch or RIB ends after this time, finished or not
_STREAK_MAX = 8
_SLACK = 0.25  # of a period


def now() -> Timestamps:
    """Return the present time of both clocks."""
    return Timestamps(time.monotonic(), time.time())


@dataclass(slots=True)
class Periodic:
    """Function that a loop calls once in a period, and not while it has no work.

    It is called up to a quarter of its period early or late, with what else wakes the loop, and kept on average: so
    functions of several periods share a wake-up. Source: timerslack, prctl(2).
    """

    period_s: float
    call: Callable[[Timestamps], None]
    has_work: Callable[[], object]
    due_s: float = float("-inf")

    def handle(self, moment: Timestamps) -> None:
        """Call the function if it is due, or soon; one that waited is due the sooner again."""
        if moment.mono_s >= self.due_s - self.period_s * _SLACK and self.has_work():
            self.due_s = max(self.due_s, moment.mono_s - self.period_s * _SLACK) + self.period_s
            self.call(moment)


class Runtime:
    """Loop that drives a protocol core over a plane.

    Args:
        costs: of ports by device name, ``COST_AUTO``: measured; others cost ``COST_DEFAULT``.
        spin_s: seconds to poll before sleeping, if frames follow each other closely; 0: never.
    """

    def __init__(
        self, machine: NodeCore, plane: Plane, costs: Mapping[str, int] | None = None, *, spin_s: float = 0.0
    ) -> None:
        self._machine = machine
        self._plane = plane
        self._costs = dict(costs or {})
        self._spin = BusyPoll(spin_s)
        self._stops = 0  # calls of ``stop``
        self._is_woken = False  # by a watched source: the driver has work
        self._streak = 0  # consecutive steps with frames and without a check of the timers
        self._deadline_s: float | None = None
        self._periodic: list[Periodic] = []
        self._after_receive: list[Callable[[], None]] = []
        self._keepalives = keepalives = plane.keepalives
        self._has_reports = False
        if keepalives is not None:
            self.every(UPKEEP_S, self._take_reports, lambda: keepalives.due_s != NEVER_S)
        self._drain_until_s: float | None = None
        self._is_finished: Callable[[], bool] = lambda: True
        self.has_drained = False
        machine.count_arrivals(plane.frames_from)
        moment = now()
        for port in list(plane.ports.values()):
            self._add(port.index, moment)
        plane.on_link(self._link_changed)

    @property
    def is_stopped(self) -> bool:
        """Return whether ``stop`` was called."""
        return self._stops > 0

    def stop(self) -> None:
        """End ``run``, or ``linger``, after the present step."""
        self._stops += 1

    def run(self, until: Callable[[], bool] | None = None, deadline_s: float | None = None) -> bool:
        """Work until stopped, until ``until`` is true (checked after each step), or until a monotonic second.

        Returns whether ``until`` came true (without one: whether the node was stopped).
        """
        while not self._stops:
            if until is not None and until():
                return True
            if deadline_s is not None and time.monotonic() >= deadline_s:
                return False
            self.step(time.monotonic() + LOOK_S if self.is_draining else deadline_s)
            self._end_when_drained()
        return until is None

    def linger(self, deadline_s: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Work although stopped, until ``until`` is true or until a monotonic second; another ``stop`` ends it.

        Returns whether ``until`` came true.
        """
        stops = self._stops
        while not until():
            if self._stops > stops or time.monotonic() >= deadline_s:
                return False
            self.step(deadline_s)
        return True

    def watch(self, source: HasFileno, ready: Callable[[], None] | None = None) -> None:
        """End a step as soon as ``source`` is readable, after calling ``ready`` from within it."""

        def wake() -> None:
            """Call ``ready``, and end the step."""
            self._is_woken = True
            if ready is not None:
                ready()

        self._plane.watch(source, wake)

    def add_port(self, ifname: str, cost: int) -> int:
        """Begin to use a device, which may be missing yet; return its port index.

        Raises:
            LocalError: as ``Plane.add_port``.
        """
        self._costs[ifname] = cost
        index = self._plane.add_port(ifname, may_be_absent=True)
        self._add(index, now())
        self._deadline_s = time.monotonic()
        return index

    def remove_port(self, index: int) -> None:
        """Stop using a port; its neighbours are lost at once."""
        self._machine.port_changed(index, False, now())
        port = self._plane.ports.get(index)
        if port is not None:
            self._costs.pop(port.ifname, None)
        self._plane.remove_port(index)
        self._deadline_s = time.monotonic()

    def drain(self, is_finished: Callable[[], bool], timeout_s: float) -> None:
        """End ``run`` when ``is_finished`` and nothing is left to send, or after ``timeout_s`` seconds."""
        self._drain_until_s = time.monotonic() + timeout_s
        self._is_finished = is_finished

    @property
    def is_draining(self) -> bool:
        """Return whether ``drain`` was called."""
        return self._drain_until_s is not None

    def every(
        self, period_s: float, function: Callable[[Timestamps], None], has_work: Callable[[], object] = lambda: True
    ) -> None:
        """Call ``function`` from within the loop each ``period_s``, the first time at once; not while it has no work.

        Args:
            has_work: its answer changes within a step of the loop alone, or the loop is woken otherwise.
        """
        self._periodic.append(Periodic(period_s, function, has_work))

    def after_receive(self, function: Callable[[], None]) -> None:
        """Call ``function`` each time that the core has handled frames; it must be cheap."""
        self._after_receive.append(function)

    def unwatch(self, source: HasFileno) -> None:
        """Undo ``watch``, before the source is closed."""
        self._plane.unwatch(source)

    def step(self, latest_s: float | None = None) -> None:
        """Wait for an event, no longer than until a monotonic second, and handle it.

        While the core has more to send, the step does not wait, but it handles frames that arrived: a large outgoing
        message does not delay received frames.
        """
        self._is_woken = False
        is_sending = self.send()
        arrivals: Sequence[ReceivedFrame] = ()
        if is_sending or (self._streak and self._deadline_s is not None):
            arrivals = self._plane.poll(0.0)
        if not is_sending and not arrivals and not self._is_woken:
            self._deadline_s = self._machine.get_timer()
            due_s = self._deadline_s
            if due_s is not None and len(self._plane.ports) == 1:
                due_s = self._machine.offload.latest_s(due_s)
            first_s = earliest(due_s, latest_s, self._periodic_s())
            arrivals = self._wait(None if first_s is None else max(first_s - time.monotonic(), 0.0))
        elif self._deadline_s is None:
            self._deadline_s = self._machine.get_timer()
        self._streak = self._streak + 1 if arrivals and self._streak < _STREAK_MAX else 0
        moment = now()
        keepalives, has_news = self._keepalives, False
        if keepalives is not None and keepalives.has_news:
            has_news = True
            self._take_runs(*keepalives.poll(moment.mono_s), moment)
        if arrivals:
            self._machine.receive(arrivals, moment)
            if len(self._plane.ports) == 1 and self._machine.offload.frames_came(moment.mono_s):
                self._deadline_s = moment.mono_s  # a node with one link is woken once for what comes and what leaves
            for follow in self._after_receive:
                follow()
        if self._deadline_s is not None and moment.mono_s >= self._deadline_s:
            self._machine.handle_timer(moment)
            self.send()  # keepalives and reports, of which most often no more follow
            has_news, self._deadline_s = True, None
        for each in self._periodic:
            each.handle(moment)
        if keepalives is not None and (has_news or self._has_reports):
            self._has_reports = False
            offers = self._machine.offload.offers(moment.mono_s)
            self._take_runs(keepalives.follow(offers, self._plane.ports), 0.0, moment)

    def _periodic_s(self) -> float | None:
        """Return until when the next periodic function waits; None: all wait for work."""
        first_s: float | None = None
        for each in self._periodic:
            latest_s = each.due_s + each.period_s * _SLACK
            if (first_s is None or latest_s < first_s) and each.has_work():
                first_s = latest_s
        return first_s

    def _take_reports(self, moment: Timestamps) -> None:
        """Tell the core what the plane did in the keepalive sessions that last."""
        self._has_reports = True
        if self._keepalives is not None:
            self._take_runs(*self._keepalives.poll(moment.mono_s, reports=True), moment)

    def _take_runs(self, runs: list[KeepaliveRun], late_s: float, moment: Timestamps) -> None:
        """Tell the core what the plane did in keepalive sessions; of one that is over, timers may be due now."""
        if runs or late_s:
            self._machine.offload.take_runs(runs, late_s, moment)
        if any(each.is_over for each in runs):
            self._deadline_s = moment.mono_s

    def _end_when_drained(self) -> None:
        if self._drain_until_s is None:
            return
        self.has_drained = self._is_finished() and not self.send()
        if self.has_drained or time.monotonic() >= self._drain_until_s:
            self.stop()

    def next_due_s(self) -> float | None:
        """Return the monotonic second at which a step has work without frames, or None."""
        keepalives = self._keepalives
        tick_s = None if keepalives is None or keepalives.due_s == NEVER_S else keepalives.due_s
        return earliest(self._machine.get_timer(), tick_s, self._periodic_s())

    def _wait(self, timeout_s: float | None) -> Sequence[ReceivedFrame]:
        """Wait for frames; if they follow each other closely, poll for a moment before sleeping."""
        begun_s = time.monotonic()
        if self._spin.pays:
            spin_s = self._spin.longest_s if timeout_s is None else min(self._spin.longest_s, timeout_s)
            while (waited_s := time.monotonic() - begun_s) < spin_s:
                arrivals = self._plane.poll(0.0)
                if arrivals or self._is_woken:
                    self._spin.waited(waited_s)
                    return arrivals
                os.sched_yield()  # lets other threads use this CPU first
            if timeout_s is not None:
                timeout_s = max(timeout_s - waited_s, 0.0)
        arrivals = self._plane.poll(timeout_s)
        if arrivals or self._is_woken:
            self._spin.waited(time.monotonic() - begun_s)
        return arrivals

    def send(self) -> bool:
        """Send the core's next frames; return whether there may be more."""
        for index, macs in self._machine.poll_neighbours().items():
            self._plane.set_neighbours(index, macs)
        transmits = self._machine.frames_to_send(time.monotonic())
        if not transmits:
            return False
        sent_s = time.monotonic()
        for port, mac, frames in transmits:
            self._plane.transmit(port, mac, frames)
        self._machine.frames_sent(sent_s)
        return True

    @contextlib.contextmanager
    def signals(self, reload: Callable[[], None] | None = None) -> Iterator[None]:
        """End ``run`` on SIGINT and SIGTERM until the context ends; a blocked ``poll`` wakes up for them.

        Args:
            reload: called within the loop after a SIGHUP.
        """
        tune_memory()
        with handled_signals(self.stop, reload) as (reading, drain):
            self._plane.watch(reading, drain)
            try:
                yield
            finally:
                self._plane.unwatch(reading)

    def _add(self, index: int, moment: Timestamps) -> None:
        port = self._plane.ports[index]
        cost = self._costs.get(port.ifname, COST_DEFAULT)
        self._machine.add_port(index, port.mac, port.mtu, cost, moment)
        if not port.up:
            self._machine.port_changed(index, False, moment)

    def _link_changed(self, index: int, up: bool) -> None:
        moment = now()
        port = self._plane.ports.get(index)
        log.info("link port=%s up=%s mtu=%d", "?" if port is None else port.ifname, up, 0 if port is None else port.mtu)
        if up and port is not None:
            self._add(index, moment)  # the port may have another address, or only its MTU changed
        else:
            self._machine.port_changed(index, up, moment)
        self._deadline_s = moment.mono_s
