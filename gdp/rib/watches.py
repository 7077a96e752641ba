"""Who wants to be told of changes to a name, and until when.

Place: pure; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

from gdp.errors import DropReason, StatementError
from gdp.limits import RIB_WATCHES_MAX
from gdp.names import Name

__all__ = ["Watches"]


class Watches:
    """Watches by name and asker.

    Args:
        maximum: how many there may be at once.
    """

    def __init__(self, maximum: int = RIB_WATCHES_MAX) -> None:
        self._maximum = maximum
        self._by_name: dict[Name, dict[Name, float]] = {}
        self._size = 0
        self._expire_at_s = float("inf")  # no watch ends before

    def __len__(self) -> int:
        return self._size

    def add(self, name: Name, asker: Name, until_s: float) -> None:
        """Watch, or watch on.

        Raises:
            StatementError: QUOTA.
        """
        watchers = self._by_name.setdefault(name, {})
        if asker not in watchers:
            if self._size >= self._maximum:
                if not watchers:
                    del self._by_name[name]
                raise StatementError(DropReason.QUOTA, "watches")
            self._size += 1
        watchers[asker] = max(until_s, watchers.get(asker, until_s))
        self._expire_at_s = min(self._expire_at_s, until_s)

    def watchers(self, name: Name, now_s: float) -> list[Name]:
        """Return who watches a name now."""
        return [asker for asker, until_s in self._by_name.get(name, {}).items() if until_s > now_s]

    def until_s(self, name: Name) -> float | None:
        """Return when the last watch of a name ends, or None."""
        return max(self._by_name.get(name, {}).values(), default=None)

    def expire(self, now_s: float) -> None:
        """Forget watches that ended."""
        if now_s < self._expire_at_s:
            return
        for name in list(self._by_name):
            watchers = self._by_name[name]
            for asker in [asker for asker, until_s in watchers.items() if until_s <= now_s]:
                del watchers[asker]
                self._size -= 1
            if not watchers:
                del self._by_name[name]
        ends = (until_s for watchers in self._by_name.values() for until_s in watchers.values())
        self._expire_at_s = min(ends, default=float("inf"))
