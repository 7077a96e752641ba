"""Watches: which members are notified of changes to a name, and until when.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

import heapq
from typing import NamedTuple

from gdp.errors import DropReason, StatementError
from gdp.limits import RIB_WATCHES_MAX
from gdp.message.shares import Shares
from gdp.names import Name

__all__ = ["Asker", "Watches"]


class Asker(NamedTuple):
    """A proven member that queries or watches."""

    name: Name
    domain: Name
    is_rib: bool


class Watches:
    """Watches by name and asker; their ends are in a heap, whose entries are renewed when they reach the top.

    Args:
        maximum: how many there may be at once, shared among the askers and their domains.
    """

    def __init__(self, maximum: int = RIB_WATCHES_MAX) -> None:
        self._by_name: dict[Name, dict[Asker, float]] = {}
        self._ends: list[tuple[float, Name, Asker]] = []
        self._shares = Shares(maximum)

    def __len__(self) -> int:
        return len(self._shares)

    def add(self, name: Name, asker: Asker, until_s: float) -> None:
        """Add or renew a watch. Raises ``StatementError``: QUOTA."""
        watchers = self._by_name.get(name)
        known_s = None if watchers is None else watchers.get(asker)
        if known_s is not None and watchers is not None:
            watchers[asker] = max(until_s, known_s)
            return
        if not self._shares.reserve(asker.name, asker.domain):
            raise StatementError(DropReason.QUOTA, "watches")
        self._by_name.setdefault(name, {})[asker] = until_s
        heapq.heappush(self._ends, (until_s, name, asker))

    def watchers(self, name: Name, now_s: float) -> list[Asker]:
        """Return the askers that watch a name now."""
        return [asker for asker, until_s in self._by_name.get(name, {}).items() if until_s > now_s]

    def names(self) -> list[Name]:
        """Return every watched name."""
        return list(self._by_name)

    def expire(self, now_s: float) -> None:
        """Remove watches that ended."""
        while self._ends and self._ends[0][0] <= now_s:
            _, name, asker = self._ends[0]
            until_s = self._by_name[name][asker]
            if until_s > now_s:
                heapq.heapreplace(self._ends, (until_s, name, asker))
                continue
            heapq.heappop(self._ends)
            del self._by_name[name][asker]
            if not self._by_name[name]:
                del self._by_name[name]
            self._shares.release(asker.name, asker.domain)
