"""Snapshot requests of a replicated log: which replica is asked for its state, and until when."""

from __future__ import annotations

from typing import Final

from gdp.names import Name
from gdp.service.dispatch import Ask
from gdp.service.replicas import Replicas
from gdp.service.replicated_log import ReplicatedLog
from gdp.service.replication_messages import LogId, ReplicaCommand, Snapshot, SnapshotRequest

LOAD_S: Final = 10.0  # until a replica counts as silent that has a snapshot to send, or to load


class SnapshotRequests:
    """At most one request at a time; ``effects``: requests to send are appended here."""

    def __init__(self, effects: list[Ask | ReplicaCommand]) -> None:
        self._effects = effects
        self._server: Name | None = None
        self._until_s = 0.0

    @property
    def is_pending(self) -> bool:
        """Return whether a replica is asked now."""
        return self._server is not None

    def request(self, log: LogId, replicas: Replicas, entries: ReplicatedLog, now_s: float) -> bool:
        """Ask the furthest replica that has a newer state; return whether there is one."""
        tellers = replicas.tellers()
        server = max(tellers, key=lambda name: tellers[name], default=None)
        if server is None or (entries.state is not None and tellers[server] <= entries.state.at):
            return False
        self._server = server
        self._until_s = now_s + LOAD_S
        self._effects.append(ReplicaCommand(server, SnapshotRequest(log)))
        return True

    def handle_state(self, server: Name, state: Snapshot, log: LogId, entries: ReplicatedLog) -> bool:
        """Return whether a snapshot is the one that was requested; if so, the request is over."""
        if server != self._server or state.log != log or state.at > entries.last:
            return False
        self._server = None
        return True

    def cancel(self, server: Name) -> None:
        """Drop the request to a replica that has gone."""
        if self._server == server:
            self._server = None

    def handle_timer(self, now_s: float) -> None:
        """Drop a request whose timeout has passed."""
        if self._server is not None and now_s >= self._until_s:
            self._server = None
