"""Replicas of a service with state, as its sequencer knows them."""

from __future__ import annotations

from dataclasses import dataclass

from gdp.names import Name
from gdp.service.replication_messages import ReplicaStatus


@dataclass(slots=True, eq=False, kw_only=True)
class Replica:
    """One replica.

    Args:
        quiet_until_s: until when it receives no further probe.
        follows: it reported that it follows the sequencer's log.
        is_offered: it was asked to follow, and has not yet replied.
        sent: it has, or was sent, the entries up to here.
        why_not: why it cannot follow; empty: it can.
    """

    quiet_until_s: float
    position: ReplicaStatus | None = None
    follows: bool = False
    is_offered: bool = False
    sent: int = 0
    why_not: str = ""

    def start_over(self) -> None:
        """Reset the replica to follow nothing; a report of another sequencer stays until a newer report."""
        self.follows, self.is_offered, self.quiet_until_s = False, False, 0.0
        if self.position is not None and self.position.kept_by is None:
            self.position = None


class Replicas(dict[Name, Replica]):
    """All replicas, by name."""

    def following(self) -> dict[Name, ReplicaStatus]:
        """Return the positions of those that follow."""
        places = ((name, each.position) for name, each in self.items() if each.follows)
        return {name: position for name, position in places if position is not None}

    def tellers(self) -> dict[Name, int]:
        """Return those that follow and can save a snapshot, and after which entry."""
        return {name: position.at for name, position in self.following().items() if position.tells}

    def known(self) -> dict[Name, ReplicaStatus]:
        """Return the positions of those that have reported one."""
        return {name: each.position for name, each in self.items() if each.position is not None}

    def is_kept_otherwise(self) -> bool:
        """Return whether one follows another sequencer."""
        return any(position.kept_by is not None for position in self.known().values())
