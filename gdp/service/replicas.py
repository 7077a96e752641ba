"""The replicas of a service that keeps state, as its keeper knows them.

Place: pure.
"""

from __future__ import annotations

from dataclasses import dataclass

from gdp.names import Name
from gdp.service.replication_messages import ReplicaStatus

__all__ = ["Replica", "Replicas"]


@dataclass(slots=True, eq=False)
class Replica:
    """One replica.

    Args:
        quiet_until_s: until when it is not asked again.
        follows: it said that it stands in the keeper's log.
        is_offered: it was told to follow, and has not said yet whether it does.
        sent: it has, or was sent, the entries up to here.
        why_not: why it cannot follow; empty: it can.
    """

    quiet_until_s: float
    position: ReplicaStatus | None = None
    follows: bool = False
    is_offered: bool = False
    sent: int = 0
    why_not: str = ""

    def begin_anew(self) -> None:
        """Follow nothing; who keeps it otherwise is remembered until it says another thing."""
        self.follows, self.is_offered, self.quiet_until_s = False, False, 0.0
        if self.position is not None and self.position.kept_by is None:
            self.position = None


class Replicas(dict[Name, Replica]):
    """All of them, by name."""

    def following(self) -> dict[Name, ReplicaStatus]:
        """Return where those are that follow."""
        places = ((name, each.position) for name, each in self.items() if each.follows)
        return {name: position for name, position in places if position is not None}

    def tellers(self) -> dict[Name, int]:
        """Return those that follow and can tell their state, and after which entry."""
        return {name: position.at for name, position in self.following().items() if position.tells}

    def known(self) -> dict[Name, ReplicaStatus]:
        """Return where those are that have said so."""
        return {name: each.position for name, each in self.items() if each.position is not None}

    def is_kept_otherwise(self) -> bool:
        """Return whether one follows another keeper."""
        return any(position.kept_by is not None for position in self.known().values())
