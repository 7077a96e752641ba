"""Sequencer of one service with state, at its client: every request goes to all replicas in one order.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds), randomness as ``incarnation_id``. ``poll_effects`` returns
what to send. It has the methods of a ``Dispatch``, which serves services without state.

::

    collecting: every replica gets a probe            --COLLECT_S after the last one joined-->  sequencing
    sequencing: entries go to all followers           --one has followed a greater log-->       collecting; calls fail

It joins ``election.py`` (which log wins), ``replicated_log.py`` (its entries), ``log_replication.py`` (which replica
has which entries) and ``snapshots.py`` (snapshots that replace entries). Replicas that did not begin at the root load a
snapshot. Without snapshots, only those follow that are where the root was.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final, Generic, TypeAlias, TypeVar

from gdp.errors import LocalError
from gdp.names import Name
from gdp.service.dispatch import Ask, Failure
from gdp.service.election import Election
from gdp.service.log_replication import STALL_S, LogReplication
from gdp.service.pending import Pending
from gdp.service.replicas import Replica, Replicas
from gdp.service.replicated_log import ReplicatedLog
from gdp.service.replication_messages import (
    INCARNATION_BITS,
    NO_LOG,
    AttachReplica,
    FollowerMessage,
    LogId,
    ReplicaCommand,
    ReplicaProbe,
    ReplicaStatus,
    Snapshot,
    call_of,
    place_of,
)
from gdp.service.snapshots import LOAD_S, SnapshotRequests

A = TypeVar("A")

GENERATION_MAX: Final = 1 << 63  # no log gets this far; the next generation must still fit into 64 bits
AGAIN_S: Final = 0.25  # between probes of a replica that does not follow
_UNLIKE: Final = "its state differs from the others', and theirs cannot be sent to it"
_UNKNOWN: Final = "what state its server is in is not known; restart it"


Effect: TypeAlias = "Ask | ReplicaCommand"


class Sequencer(Generic[A]):
    """The calls of one service from this client, and the log of them.

    Args:
        incarnation_id: returns 32 random bits.
        entries: returns an empty log.

    Attributes:
        late: responses that came for a call that had ended: those of all replicas but the first.
        unexpected: responses of replicas that do not follow.
        hedged: always none; every replica gets every request.
        log: the log that it keeps; of generation 0 before it begins.
    """

    def __init__(
        self, *, incarnation_id: Callable[[], int], entries: Callable[[], ReplicatedLog] = ReplicatedLog
    ) -> None:
        self._incarnation_id = incarnation_id
        self._new_entries = entries
        self._replicas = Replicas()
        self._effects: list[Effect] = []
        self._election = Election()
        self._restart()
        self.late = 0
        self.unexpected = 0
        self.hedged = 0

    def _restart(self) -> None:
        """Discard the log; no replica follows it."""
        self.log = LogId(0, self._incarnation_id() or 1)
        self._calls = Pending[A](call_of(self.log, 1))
        self._entries = self._new_entries()
        self._replication = LogReplication(
            log=self.log, entries=self._entries, replicas=self._replicas, effects=self._effects
        )
        self._snapshots = SnapshotRequests(self._effects)
        self._base = (NO_LOG, 0)  # position of a replica at which the log begins
        self._is_keeping = False
        for replica in self._replicas.values():
            replica.start_over()

    def __len__(self) -> int:
        return len(self._calls)

    def __contains__(self, number: int) -> bool:
        incarnation_id, index = place_of(number)
        return incarnation_id == self.log.incarnation_id and index in self._entries

    @property
    def servers(self) -> list[Name]:
        """Return the replicas that are there."""
        return list(self._replicas)

    @property
    def outside(self) -> Mapping[Name, str]:
        """Return the replicas that cannot follow, and why."""
        return {name: replica.why_not for name, replica in self._replicas.items() if replica.why_not}

    def begin(
        self,
        now_s: float,
        write: Callable[[int], bytes],
        timeout_s: float | None,
        answered: Callable[[A], None],
        failed: Callable[[Failure, str], None],
        first: Sequence[Name] = (),
    ) -> int:
        """Append a request to the log; return its number. One of the callbacks is called, once, and never from here.

        A call that fails may have been applied all the same, or be applied later; one that raises is not.

        Raises:
            LocalError: there is no replica, another sequencer orders this service, or the log is full.
        """
        assert not first
        if not self._replicas:
            raise LocalError("no server is there")
        if self._election.leader is not None:
            raise LocalError(f"kept in order by {self._election.leader.short}")
        if self._entries.is_full:
            raise LocalError(f"the log is full: {len(self._entries)} requests, and no state that stands for them")
        if self._entries.last + 1 >> INCARNATION_BITS:
            raise LocalError("the log is at its end; restart this proxy")
        number = self._calls.begin(now_s, timeout_s, answered, failed)
        self._replication.append(number, write(number), now_s)
        self._request_snapshot_if_wanted(now_s)
        return number

    def replica_joined(self, server: Name, now_s: float) -> None:
        """Add a replica."""
        if server not in self._replicas:
            self._replicas[server] = Replica(quiet_until_s=0.0)
            self._election.restart(now_s)
            self._advance(now_s)

    def replica_leaving(self, server: Name) -> None:
        """Record that a replica goes soon: where others follow it is detached."""
        if any(replica.follows for name, replica in self._replicas.items() if name != server):
            self._let_go(server)

    def replica_lost(self, server: Name, now_s: float, reason: str) -> None:
        """Remove a replica. Its calls stay pending, for later replicas get the log."""
        del reason
        self._let_go(server)
        self._advance(now_s)

    def positioned(self, server: Name, word: FollowerMessage, now_s: float) -> None:
        """Handle a replica's message about itself."""
        replica = self._replicas.get(server)
        if replica is None or word.log.generation >= GENERATION_MAX:
            self.unexpected += 1
        elif isinstance(word, Snapshot):
            self._handle_state(server, replica, word, now_s)
        else:
            self._handle_position(server, replica, word, now_s)
        self._advance(now_s)

    def answered(self, number: int, server: Name, answer: A, now_s: float) -> None:
        """Handle a replica's response: it has applied everything up to there."""
        if self._replication.handle_done(server, *place_of(number), now_s):
            self.late += not self._calls.handle_response(number, answer)
        else:
            self.unexpected += 1

    def refused(self, number: int, server: Name, reason: str, now_s: float) -> None:
        """Handle a replica's refusal: it may follow another sequencer by now."""
        replica = self._replicas.get(server)
        if replica is not None and replica.follows:
            self._ask(server, replica, now_s)
            self._calls.refuse(number, server, reason, self._replicas.following().keys())

    def declined(self, number: int, server: Name, answer: A, now_s: float) -> None:
        """Handle a response that declines; for a service with state all responses are equal."""
        self.answered(number, server, answer, now_s)

    def handle_timer(self, now_s: float) -> None:
        """Run the timers that are due."""
        self._calls.fail_expired(now_s)
        self._advance(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timeout of a call, or None; all else can wait for a tick."""
        return self._calls.get_timer()

    def fail_all(self, reason: str) -> None:
        """End every call. The log stays: later replicas get it."""
        self._calls.fail_all(Failure.NO_SERVER, reason)

    def poll_effects(self) -> list[Effect]:
        """Return, once, what to send, in order."""
        effects = self._effects.copy()
        self._effects.clear()
        return effects

    def _advance(self, now_s: float) -> None:
        """Probe replicas that owe a position; begin the log when all have sent theirs."""
        for server, replica in self._replicas.items():
            is_behind = self._replication.is_behind(replica)
            if now_s >= replica.quiet_until_s and (is_behind or not replica.follows):
                self._ask(server, replica, now_s)
        self._snapshots.handle_timer(now_s)
        is_sent = self._replication.is_sent
        if not is_sent and not any(each.follows or each.is_offered for each in self._replicas.values()):
            self._is_keeping = False  # no replica accepted it: it may begin from another one
        if not self._is_keeping and self._replicas and self._election.is_due(now_s):
            self._begin_log(now_s)
        self._request_snapshot_if_wanted(now_s)

    def _ask(self, server: Name, replica: Replica, now_s: float) -> None:
        replica.quiet_until_s = now_s + (STALL_S if replica.follows else AGAIN_S)
        replica.is_offered = False
        self._effects.append(ReplicaCommand(server, ReplicaProbe(self.log.incarnation_id)))

    def _let_go(self, server: Name) -> None:
        self._replicas.pop(server, None)
        self._snapshots.cancel(server)
        if not self._replicas:
            self._election.leader = None

    def _handle_position(self, server: Name, replica: Replica, position: ReplicaStatus, now_s: float) -> None:
        replica.position = position
        replica.why_not, replica.is_offered = "", False
        replica.quiet_until_s = now_s + AGAIN_S
        if position.kept_by is not None:
            replica.follows = False
            self._handle_leader(position.kept_by, position.log, now_s)
            return
        if not self._replicas.is_kept_otherwise():
            self._election.leader = None
        is_ours = self._is_keeping and position.log == self.log
        replica.follows = is_ours and self._replication.can_serve(position.held)
        if replica.follows:
            self._replication.follow(server, replica, position.held, now_s)
        elif self._is_keeping and position.log > self.log:
            self._calls.fail_all(Failure.REFUSED, "another kept this service in order meanwhile")
            self._election.restart(now_s)
            self._restart()
        elif self._is_keeping:
            self._admit(server, replica, position, now_s)

    def _handle_leader(self, leader: Name, log: LogId, now_s: float) -> None:
        """Record that a replica follows another sequencer, and yield to it if its log wins."""
        if self._replicas.following() and log < self.log:  # the own one has begun and is greater
            return
        self._election.leader = leader
        self._calls.fail_all(Failure.REFUSED, f"kept in order by {leader.short}")
        if self._is_keeping or self._entries.last:
            self._election.restart(now_s)
            self._restart()

    def _begin_log(self, now_s: float) -> None:
        """Begin the log with the elected replica, if there is one."""
        elected = self._election.elect(self._replicas, self.log.incarnation_id)
        if elected is None:
            return
        best = elected.position
        self.log = self._replication.log = elected.log
        # where it is the same one it accepted this log, and its status was lost
        if best.log.incarnation_id != self.log.incarnation_id:
            self._base = best.log, best.at
        self._is_keeping, self._election.leader = True, None
        for replica in self._replicas.values():
            replica.why_not = ""
        root = elected.root
        self._follow(root, self._replicas[root], AttachReplica(self.log, 0, best.log, best.at, None), now_s)

    def _follow(self, server: Name, replica: Replica, word: AttachReplica, now_s: float) -> None:
        replica.quiet_until_s, replica.is_offered = now_s + LOAD_S, True
        self._effects.append(ReplicaCommand(server, word))

    def _admit(self, server: Name, replica: Replica, position: ReplicaStatus, now_s: float) -> None:
        """Make a replica follow, from where it can."""
        state, is_level = self._entries.state, self._is_level(position) and not self._entries.forgotten
        if not self._replicas.following() and not self._replication.is_sent:
            return  # the root comes first
        if position.tells and (position.is_fresh or not is_level):
            if state is not None:
                word = AttachReplica(self.log, state.at, position.log, position.at, state.state)
                self._follow(server, replica, word, now_s)
                return
            if self._snapshots.is_pending or self._snapshots.request(self.log, self._replicas, self._entries, now_s):
                return  # it is admitted when the snapshot is here
        if is_level:
            self._follow(server, replica, AttachReplica(self.log, 0, position.log, position.at, None), now_s)
        else:
            replica.why_not = _UNKNOWN if position.is_lost else _UNLIKE

    def _is_level(self, position: ReplicaStatus) -> bool:
        """Return whether a replica is where the log begins."""
        is_begun = position.log.incarnation_id == self.log.incarnation_id and position.at == 0
        return not position.is_lost and (is_begun or (position.log, position.at) == self._base)

    def _request_snapshot_if_wanted(self, now_s: float) -> None:
        """Request a snapshot when the log has grown, or to begin with."""
        if self._is_keeping and not self._snapshots.is_pending and self._entries.wants_state:
            self._snapshots.request(self.log, self._replicas, self._entries, now_s)

    def _handle_state(self, server: Name, replica: Replica, word: Snapshot, now_s: float) -> None:
        if not self._snapshots.handle_state(server, word, self.log, self._entries):
            return
        if word.state is None:
            if replica.position is not None:
                replica.position = replica.position._replace(tells=False)
            self._ask(server, replica, now_s)
        else:
            self._entries.restore_snapshot(word)
        self._replication.trim()
        for name, each in self._replicas.items():
            if each.follows:
                self._replication.send_missing(name, each)
            elif each.position is not None and each.position.kept_by is None and not each.is_offered:
                self._admit(name, each, each.position, now_s)
