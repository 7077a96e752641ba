"""Election of the log that orders a service: with which replica it begins, and which sequencer yields.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

The log begins with the replica that is furthest, and among equals the one with the least name. So of two sequencers
that begin at once only one gets it. Of two logs the greater wins.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from gdp.names import Name
from gdp.service.replicas import Replicas
from gdp.service.replication_messages import LogId, ReplicaStatus

COLLECT_S: Final = 1.0  # after the last replica joined, before the log begins without silent replicas
_UNKNOWN: Final = "what state its server is in is not known; restart it"


class Elected(NamedTuple):
    """The log that begins, and where.

    ``root``: the replica that it begins with; ``position``: where the furthest replicas are.
    """

    log: LogId
    root: Name
    position: ReplicaStatus


class Election:
    """What one sequencer knows about the other logs of its service.

    Attributes:
        leader: another sequencer, whose log a replica follows; None: no other is known.
    """

    def __init__(self) -> None:
        self.leader: Name | None = None
        self._collect_until_s = 0.0

    def restart(self, now_s: float) -> None:
        """Collect positions again, since replicas have changed."""
        self._collect_until_s = now_s + COLLECT_S

    def is_due(self, now_s: float) -> bool:
        """Return whether the time for silent replicas is over."""
        return now_s >= self._collect_until_s

    def elect(self, replicas: Replicas, instance: int) -> Elected | None:
        """Return the log that begins now, or None while it may not.

        A replica whose state is unknown is marked so. A root that has entries left to apply is asked again later.

        Args:
            instance: the own log's 32 random bits.
        """
        known = replicas.known()
        if replicas.is_kept_otherwise():
            return None
        sound = {name: position for name, position in known.items() if not position.is_lost}
        for name in known.keys() - sound.keys():
            replicas[name].why_not = _UNKNOWN
        if not sound:
            return None
        best = max(sound.values(), key=lambda position: (position.log, position.held, position.at))
        if best.at < best.held:
            return None
        root = min(name for name, each in sound.items() if (each.log, each.at) == (best.log, best.at))
        generation = max(position.log.generation for position in known.values()) + 1
        return Elected(LogId(generation, instance), root, best)
