"""Choice of the nearest server: rank by the cost of the path, and detection of a server that died with calls.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Sources: RFC 4786 (anycast: the nearest copy by the metric of
the routing); RFC 5880 (detection time), of which the interval and the multiplier are those of neighbours.

Any report of a server shows that it is alive, also while it works on a call. Its reports end with it, and with the path
in either direction. A server that owes a response is therefore probed, and each probe draws a report. A server without
calls is not probed; its reports every ``SERVER.refresh_s`` show when it has returned.
"""

from __future__ import annotations

from typing import Final, NamedTuple, Protocol

from gdp.due_queue import DueQueue
from gdp.intervals import LOOK_S, NEVER_S, OWING
from gdp.limits import REPORT_DELAY_S
from gdp.names import Name

_TRIPS: Final = 1.25  # after which the first report is late


class ServerPath(NamedTuple):
    """Path to one server.

    Attributes:
        cost: as the client's switch states it; ``COST_UNREACHABLE`` without a path.
        trip_s: smoothed round trip in seconds; 0: not measured.
        heard_s: monotonic second of the server's last report.
        deaf_s: monotonic second until which the client was attached to no switch.
    """

    cost: int
    trip_s: float
    heard_s: float
    deaf_s: float


class ServerPaths(Protocol):
    """Paths to the servers of one service."""

    def path(self, server: Name) -> ServerPath:
        """Return the present state of the path to a server."""


class NearestServers:
    """Rank and health of the servers of one service."""

    def __init__(self, paths: ServerPaths) -> None:
        self._paths = paths
        self._turns = DueQueue[Name]()  # of servers that owe responses: the next probe, or the end of patience
        self._since_s: dict[Name, float] = {}  # of these: an earlier silence does not count
        self._silent: dict[Name, float] = {}  # and when that was found

    def cost(self, server: Name) -> int:
        """Return the cost of the path to a server."""
        return self._paths.path(server).cost

    def is_silent(self, server: Name) -> bool:
        """Return whether a server was found silent, and has not reported since."""
        found_s = self._silent.get(server)
        if found_s is not None and self._paths.path(server).heard_s > found_s:
            del self._silent[server]
            found_s = None
        return found_s is not None

    def asked(self, server: Name, now_s: float) -> None:
        """Watch a server from now on: it owes a response."""
        if server not in self._turns:
            self._since_s[server] = now_s
            self._turns.put(server, now_s + OWING.refresh_s)

    def poll_due(self, now_s: float) -> list[Name]:
        """Return, once, the watched servers to look at now; ``probed`` watches one further."""
        due_s = self._turns.next_due()
        if due_s is not None and now_s > due_s + LOOK_S:  # this program did not run, so reports may still wait for it
            self._since_s = dict.fromkeys(self._since_s, now_s)
        due = self._turns.poll_due(now_s)
        for server in due:
            if self._silent_at_s(server) <= now_s:
                self._silent.setdefault(server, now_s)
        return due

    def probed(self, server: Name, now_s: float) -> None:
        """Look at a server again after the next probe, or when it counts as silent."""
        silent_at_s = self._silent_at_s(server)
        next_s = now_s + OWING.refresh_s
        self._turns.put(server, min(next_s, silent_at_s) if silent_at_s > now_s else next_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next look, or None."""
        return self._turns.next_due()

    def forget(self, server: Name) -> None:
        """Remove a server."""
        self._turns.discard(server)
        for known in (self._since_s, self._silent):
            known.pop(server, None)

    def _silent_at_s(self, server: Name) -> float:
        path, since_s = self._paths.path(server), self._since_s.get(server, NEVER_S)
        first_s = max(OWING.lease_s, _TRIPS * path.trip_s + 2 * REPORT_DELAY_S) if path.trip_s else 2 * OWING.lease_s
        return max(path.heard_s + OWING.lease_s, max(since_s, path.deaf_s) + first_s)
