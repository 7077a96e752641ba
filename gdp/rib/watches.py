"""Watches: which members are notified of changes to a name, and until when."""

from __future__ import annotations

from typing import Final, NamedTuple

from gdp.crypto.certificates import Membership, Role
from gdp.due_queue import DueQueue
from gdp.errors import DropReason, StatementError
from gdp.intervals import NEVER_S
from gdp.limits import RIB_WATCHES_MAX
from gdp.message.shares import Shares
from gdp.names import Name

WATCHED_S: Final = 30.0  # for which who received a response receives changes, too


class Asker(NamedTuple):
    """A proven member that queries or watches."""

    name: Name
    domain: Name
    is_rib: bool

    @classmethod
    def of(cls, member: Membership) -> Asker:
        """Return a proven member as one that queries or watches."""
        return cls(member.name, member.domain, member.role is Role.RIB)


class Watches:
    """Watches by name and asker, and the end of each.

    Args:
        maximum: how many there may be at once, shared among the askers and their domains.
    """

    def __init__(self, maximum: int = RIB_WATCHES_MAX) -> None:
        self._by_name: dict[Name, dict[Asker, None]] = {}
        self._ends = DueQueue[tuple[Name, Asker]]()
        self._shares = Shares(maximum)

    def __len__(self) -> int:
        return len(self._shares)

    def add(self, name: Name, asker: Asker, until_s: float) -> None:
        """Add or renew a watch. Raises ``StatementError``: QUOTA."""
        watch = name, asker
        known_s = self._ends.due_s(watch)
        if known_s < NEVER_S:
            self._ends.put(watch, max(until_s, known_s))
            return
        if not self._shares.reserve(asker.name, asker.domain):
            raise StatementError(DropReason.QUOTA, "watches")
        self._by_name.setdefault(name, {})[asker] = None
        self._ends.put(watch, until_s)

    def watchers(self, name: Name, now_s: float) -> list[Asker]:
        """Return the askers that watch a name now."""
        return [asker for asker in self._by_name.get(name, {}) if self._ends.due_s((name, asker)) > now_s]

    def expire(self, now_s: float) -> None:
        """Remove watches that ended."""
        for name, asker in self._ends.poll_due(now_s):
            del self._by_name[name][asker]
            if not self._by_name[name]:
                del self._by_name[name]
            self._shares.release(asker.name, asker.domain)
