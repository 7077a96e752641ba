"""Raw plane whose keepalive sessions the kernel runs, where it allows that.

I/O. A session's program stands behind all others at the ingress of a port. Between two events the plane sends what is
due, and calls nothing of the node. An end of a link that forwards nothing (RIB, proxy, session) uses it as it is.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from functools import partial

from gdp.intervals import NEVER_S
from gdp.ports.kernel.keepalives import KeepaliveSessions
from gdp.ports.plane import Port
from gdp.ports.raw import RawPlane
from gdp.ports.sockets import TrafficClass
from gdp.switch.table import Table


class KeepalivePlane(RawPlane):
    """``RawPlane`` that runs keepalive sessions.

    Args:
        sessions: of the kernel, which this plane closes; None: the node runs all.

    Raises:
        LocalError: as ``add_port``.
    """

    def __init__(
        self,
        ifnames: Sequence[str] = (),
        table: Table | None = None,
        *,
        sessions: KeepaliveSessions | None,
    ) -> None:
        self._sessions = sessions
        with ExitStack() as opened:
            if sessions is not None:
                opened.enter_context(closing(sessions))
            super().__init__(ifnames, table)
            opened.pop_all()  # from now on ``close`` closes them

    @property
    def keepalives(self) -> KeepaliveSessions | None:
        """Return the keepalive sessions that the kernel runs, as ``Plane.keepalives``."""
        return self._sessions

    def close(self) -> None:
        """Close every port, and the sessions."""
        super().close()
        if self._sessions is not None:
            self._sessions.close()

    def _wait(self, timeout_s: float | None) -> list[tuple[int, int]]:
        """Wait for events; send the keepalives that are due. The wait ends with them, if it would before the next."""
        sessions = self._sessions
        if sessions is None or sessions.due_s == NEVER_S:
            return super()._wait(timeout_s)
        now_s = time.monotonic()
        until_s = NEVER_S if timeout_s is None else now_s + timeout_s
        is_awake = sessions.has_news
        while True:
            if now_s >= sessions.due_s:
                sessions.tick(now_s)
                is_awake = sessions.has_news or sessions.due_s >= until_s
            events = self._epoll.poll(0.0 if is_awake else max(min(until_s, sessions.due_s) - now_s, 0.0))
            if events or is_awake:
                return events
            now_s = time.monotonic()
            if now_s >= until_s:
                return events

    def _open(self, port: Port) -> None:
        super()._open(port)
        if self._sessions is not None:
            self._sessions.attach(port.index, port.ifname)

    def _open_traffic_class(self, port: Port, traffic_class: TrafficClass, rank: int) -> None:
        super()._open_traffic_class(port, traffic_class, rank)
        if traffic_class is TrafficClass.CONTROL and self._sessions is not None:
            fd = self._sockets_by_class[traffic_class][port.index].fileno()
            self._ready[fd] = partial(self._take_control, self._sessions, self._ready[fd])

    def _take_control(self, sessions: KeepaliveSessions, ready: Callable[[], None]) -> None:
        """Receive control frames; the kernel may have passed a keepalive up, which ends a session that it runs."""
        sessions.has_news = True
        ready()

    def _shut(self, port: Port) -> None:
        if self._sessions is not None:
            self._closing.close(port.ifname, self._sessions.detach(port.index))
        super()._shut(port)
