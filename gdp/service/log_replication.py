"""Replication of a log to the replicas that follow it."""

from __future__ import annotations

from typing import Final

from gdp.names import Name
from gdp.service.dispatch import Ask
from gdp.service.replicas import Replica, Replicas
from gdp.service.replicated_log import ReplicatedLog
from gdp.service.replication_messages import LogId, ReplicaCommand, call_of

WINDOW: Final = 256  # entries sent to one replica ahead of what it has applied
STALL_S: Final = 1.0  # without progress of a follower, before it receives a probe


class LogReplication:
    """Sends entries to replicas, and tracks how far each is.

    Args:
        effects: messages to send are appended here.

    Attributes:
        is_sent: an entry of this log was sent.
    """

    def __init__(
        self, *, log: LogId, entries: ReplicatedLog, replicas: Replicas, effects: list[Ask | ReplicaCommand]
    ) -> None:
        self.log = log
        self.is_sent = False
        self._entries = entries
        self._replicas = replicas
        self._effects = effects

    def append(self, number: int, request: bytes, now_s: float) -> None:
        """Append an entry, and send it to every replica that is ready; ``number`` is its call's."""
        self._entries.append(request)
        last = self._entries.last
        if any(self._is_ready(replica) for replica in self._replicas.values()):
            self._effects.append(Ask(number, request, None))
            self.is_sent = True
        for server, replica in self._replicas.items():
            if self._is_ready(replica) and replica.sent == last - 1:
                replica.sent = last
                if replica.position is not None and replica.position.at == last - 1:
                    replica.quiet_until_s = now_s + STALL_S
            self.send_missing(server, replica)

    def can_serve(self, position: int) -> bool:
        """Return whether all entries behind a position are still in the log."""
        return self._entries.forgotten <= position <= self._entries.last

    def follow(self, server: Name, replica: Replica, held: int, now_s: float) -> None:
        """Make a replica follow that has the entries up to ``held``."""
        replica.quiet_until_s = now_s + STALL_S
        replica.sent = held
        self.send_missing(server, replica)

    def send_missing(self, server: Name, replica: Replica) -> None:
        """Send a replica the entries that it lacks, a few ahead of what it has applied."""
        if not self._is_ready(replica) or replica.position is None:
            return
        until = min(self._entries.last, replica.position.at + WINDOW)
        if replica.sent < until and replica.sent + 1 not in self._entries:
            replica.follows, replica.position, replica.quiet_until_s = False, None, 0.0  # it must load a snapshot
            return
        for index in range(replica.sent + 1, until + 1):
            self._effects.append(Ask(call_of(self.log, index), self._entries[index], (server,)))
            self.is_sent = True
        replica.sent = max(replica.sent, until)

    def handle_done(self, server: Name, incarnation_id: int, index: int, now_s: float) -> bool:
        """Record that a replica has applied all entries up to ``index``; return False where it does not follow."""
        replica = self._replicas.get(server)
        if replica is None or not replica.follows or replica.position is None:
            return False
        if incarnation_id != self.log.incarnation_id or index > self._entries.last:
            return False
        if index > replica.position.at:
            replica.position = replica.position._replace(at=index, held=max(index, replica.position.held))
            replica.sent = max(replica.sent, index)
            replica.quiet_until_s = now_s + STALL_S
        self.send_missing(server, replica)
        self.trim()
        return True

    def is_behind(self, replica: Replica) -> bool:
        """Return whether a replica that follows has entries left to apply."""
        return replica.follows and replica.position is not None and replica.position.at < self._entries.last

    def trim(self) -> None:
        """Remove the entries that a snapshot replaces and no replica lacks."""
        self._entries.trim(position.at for position in self._replicas.following().values())

    def _is_ready(self, replica: Replica) -> bool:
        """Return whether it may receive entries: where replicas have snapshots, the first must be here before."""
        return replica.follows and (self._entries.state is not None or not self._replicas.tellers())
