"""Latency of recent responses, and which server responded fastest recently."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from math import inf
from typing import Final

from gdp.intervals import REFUSED_S
from gdp.names import Name

RECENT: Final = 512  # responses in the percentiles
ENOUGH: Final = 32  # of them; fewer give no tail
_WEIGHT: Final = 0.2  # of the newest response in a server's average
_SORT_EVERY: Final = 16  # responses
_UNANSWERED_MAX: Final = 3  # stopped requests in succession, after which a server is asked last


@dataclass(slots=True)
class _Server:
    average_s: float | None = None
    seen_s: float = -inf  # when it was last asked or responded
    owing_s: float | None = None  # since when it is asked without any response
    unanswered: int = 0  # stopped since its last response


class Latencies:
    """The response times of one service's servers."""

    def __init__(self) -> None:
        self._recent = deque[float](maxlen=RECENT)
        self._sorted: list[float] = []
        self._unsorted = 0
        self._servers: dict[Name, _Server] = {}

    def asked(self, server: Name, now_s: float) -> None:
        """Record that a server is being tried."""
        entry = self._servers.setdefault(server, _Server())
        entry.seen_s = now_s
        entry.owing_s = now_s if entry.owing_s is None else entry.owing_s

    def answered(self, server: Name, seconds: float, now_s: float) -> None:
        """Record the response time of a server, in seconds."""
        self._learn(server, seconds, now_s).unanswered = 0

    def stopped(self, server: Name, seconds: float, now_s: float) -> None:
        """Record the time that a server had before another one responded: it may be nearly as fast, or dead."""
        self._learn(server, seconds, now_s).unanswered += 1

    def refused(self, server: Name, now_s: float) -> None:
        """Record that a server refused or declined; its speed does not count."""
        entry = self._servers.setdefault(server, _Server())
        entry.seen_s, entry.owing_s, entry.unanswered = now_s, None, _UNANSWERED_MAX

    def ended(self, seconds: float) -> None:
        """Record the time of the first copy of a request, complete or until another responded."""
        self._recent.append(seconds)
        self._unsorted += 1

    def forget(self, server: Name) -> None:
        """Remove a server."""
        self._servers.pop(server, None)

    def percentile(self, share: float) -> float | None:
        """Return within how many seconds this share of recent responses came, or None: too few."""
        if len(self._recent) < ENOUGH:
            return None
        if self._unsorted >= _SORT_EVERY or not self._sorted:
            self._sorted, self._unsorted = sorted(self._recent), 0
        return self._sorted[min(int(share * len(self._sorted)), len(self._sorted) - 1)]

    def ranked(self, servers: Iterable[Name], now_s: float) -> list[Name]:
        """Return servers in the order to ask them: untried ones, the fastest recently, those without responses."""
        return sorted(servers, key=lambda server: self._expected(server, now_s))

    def _expected(self, server: Name, now_s: float) -> tuple[bool, float]:
        """Return whether a server seems not to respond, and after how many seconds it would."""
        entry = self._servers.get(server)
        if entry is None or now_s - entry.seen_s > REFUSED_S:
            return False, -1.0
        silent_s = 0.0 if entry.owing_s is None else now_s - entry.owing_s  # it may have died
        seconds = inf if entry.average_s is None else max(entry.average_s, silent_s)
        return entry.unanswered >= _UNANSWERED_MAX, seconds

    def _learn(self, server: Name, seconds: float, now_s: float) -> _Server:
        entry = self._servers.setdefault(server, _Server())
        before = seconds if entry.average_s is None else entry.average_s
        entry.average_s, entry.seen_s = before + _WEIGHT * (seconds - before), now_s
        entry.owing_s = None
        return entry
