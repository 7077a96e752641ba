"""Flow of numbered messages through real nodes: when each was published and when it came, and what is missing.

I/O. A publisher and readers of the library in this process, each in a thread. Moments are monotonic seconds.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import pairwise
from typing import Final

import gdp
from lab.credentials import NameRights
from lab.internet.access import Access
from lab.internet.host import Host
from lab.internet.overlay import Overlay
from lab.process import FailedError

HZ: Final = 100.0
_STEADY_S: Final = 0.5
_PATIENCE_S: Final = 60.0
_LAST_S: Final = 30.0  # wait for the last messages
_NUMBER: Final = struct.Struct("!q")


def open_sessions(
    robot: Host,
    stack: ExitStack,
    rights: Sequence[NameRights],
    *,
    has_direct: bool = True,
    uplinks: Sequence[str] = (),
    lease_s: float | None = None,
) -> tuple[Overlay, Host, list[gdp.Session]]:
    """Start an overlay of a border, a robot and a server behind a NAT; return it, the server, and two sessions.

    ``rights``: of the session at the robot, and of that at the server. ``has_direct``: robot and server open a tunnel
    to each other. ``uplinks``: of the robot; none: the usual one. ``lease_s``: of the sessions' names.
    """
    laboratory = robot.laboratory
    border = laboratory.add_host("border", laboratory.add_site("dc", Access.PUBLIC))
    server = laboratory.add_host("server", laboratory.add_site("office", Access.PORT_RESTRICTED))
    overlay = Overlay(laboratory, border, {"direct": has_direct})
    overlay.stand_up(robot, server, options={robot.label: [f"--uplink={each}" for each in uplinks]})
    overlay.grant(dict(zip((robot.label, server.label), rights, strict=True)))
    return overlay, server, [stack.enter_context(overlay.open_session(host, lease_s)) for host in (robot, server)]


class NumberedFlow:
    """A flow of messages ``hz`` times a second, until ``close``.

    Args:
        publisher: of a reliable topic that all the subscriptions read.
        size: bytes of a message.

    Attributes:
        sent_s: moment of each message, by number.
        arrivals: moment and number, of each reader.
    """

    def __init__(
        self, publisher: gdp.Publisher, *subscriptions: gdp.Subscription, hz: float = HZ, size: int = 100
    ) -> None:
        self._publisher, self._period_s = publisher, 1 / hz
        self._body = bytes(size - _NUMBER.size)
        self._is_over = threading.Event()
        self.sent_s: list[float] = []
        self.arrivals: list[list[tuple[float, int]]] = [[] for _ in subscriptions]
        readings = zip(subscriptions, self.arrivals, strict=True)
        work: list[Callable[[], None]] = [self._publish, *(partial(self._read, *each) for each in readings)]
        self._threads = [threading.Thread(target=each, daemon=True) for each in work]
        for thread in self._threads:
            thread.start()

    @property
    def lost(self) -> int:
        """Return how many messages did not come, of all readers."""
        return sum(len(self.sent_s) - len({number for _, number in each}) for each in self.arrivals)

    @property
    def doubled(self) -> int:
        """Return how many arrivals were of a message that had come."""
        return sum(len(each) - len({number for _, number in each}) for each in self.arrivals)

    def _publish(self) -> None:
        due_s = time.monotonic()
        while not self._is_over.wait(max(due_s - time.monotonic(), 0.0)):
            self.sent_s.append(time.monotonic())
            self._publisher.put(_NUMBER.pack(len(self.sent_s) - 1) + self._body)
            due_s += self._period_s

    def _read(self, subscription: gdp.Subscription, arrivals: list[tuple[float, int]]) -> None:
        while not self._is_over.is_set() or len(arrivals) < len(self.sent_s):
            try:
                message = subscription.receive(timeout_s=1.0)
            except gdp.SessionError:  # nothing came
                if self._is_over.is_set() and time.monotonic() > self.sent_s[-1] + _LAST_S:
                    return
                continue
            arrivals.append((time.monotonic(), _NUMBER.unpack_from(message.payload)[0]))

    def silence_ms(self, from_s: float, to_s: float) -> float:
        """Return the longest time between two arrivals at a reader in an interval, its ends included."""
        marks = [[from_s, *(at_s for at_s, _ in list(each) if from_s <= at_s < to_s), to_s] for each in self.arrivals]
        return max(after - before for each in marks for before, after in pairwise(each)) * 1e3

    def silence_until_steady_ms(self, since_s: float, patience_s: float) -> float:
        """Wait until the flow has been back for half a second; return the longest gap since a moment.

        Raises ``FailedError``: it does not come back.
        """
        while time.monotonic() < since_s + patience_s:
            time.sleep(0.05)
            times = [at_s for at_s, _ in self.arrivals[0][-int(patience_s / self._period_s) :]]
            before = [at_s for at_s in times if at_s < since_s][-1:]
            marks = [*(before or [since_s]), *(at_s for at_s in times if at_s >= since_s)]
            now_s = time.monotonic()
            late = [mark for mark in marks if mark >= now_s - _STEADY_S]
            if now_s - since_s > 2 * _STEADY_S and len(late) > 0.8 * _STEADY_S / self._period_s:
                return max(b - a for a, b in pairwise(marks)) * 1e3
        raise FailedError("the flow did not come back")

    def close(self) -> None:
        """Stop publishing, and read what is on its way."""
        self._is_over.set()
        for thread in self._threads:
            thread.join(_PATIENCE_S)
