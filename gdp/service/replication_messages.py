"""Messages of replicated logs: requests in one order for services with state, and the positions of replicas.

Sans-I/O. Source: state machine replication (Schneider, ACM Computing Surveys 22(4), 1990), with the client's side as
the sequencer. No majority is needed: a response is given once one replica has it, as for services without state.

The client's proxy keeps the log (``sequencer.py``); each replica's proxy follows it (``follower.py``)::

    sequencer                                         follower
    ReplicaProbe     where are you? my log is ... ->
                                                  <-  ReplicaStatus
    AttachReplica    my log from here on, perhaps ->
                     with this snapshot
                                                  <-  ReplicaStatus
    entries, by the tree or again to one          ->
                                                  <-  a response to each
    SnapshotRequest  what is your state?          ->
                                                  <-  Snapshot
"""

from __future__ import annotations

from typing import Final, NamedTuple, TypeAlias

from gdp.names import Name

INCARNATION_BITS: Final = 32  # the upper half of a call's number is the log, the lower half the entry


class LogId(NamedTuple):
    """Identifier of a log. Of two the greater wins.

    ``generation``: above that of every log that its sequencer received. ``incarnation_id``: 32 random bits,
    for two that began at once.
    """

    generation: int
    incarnation_id: int


NO_LOG: Final = LogId(0, 0)  # of a server that has just started


class ReplicaProbe(NamedTuple):
    """A sequencer's probe for a replica's position; it releases a follower of the sequencer's other log."""

    incarnation_id: int


class AttachReplica(NamedTuple):
    """A sequencer's message that attaches a replica after entry ``at`` of its log.

    ``state``: the snapshot to load first. None: the replica has the state, if it is where ``log_before`` and
    ``at_before`` indicate.
    """

    log: LogId
    at: int
    log_before: LogId
    at_before: int
    state: bytes | None


class SnapshotRequest(NamedTuple):
    """A sequencer's request for a replica's state."""

    log: LogId


SequencerMessage: TypeAlias = "ReplicaProbe | AttachReplica | SnapshotRequest"


class ReplicaCommand(NamedTuple):
    """A sequencer's message to one replica."""

    server: Name
    word: SequencerMessage


class ReplicaStatus(NamedTuple):
    """The position of a replica.

    ``at``: the last entry that its server has applied; ``held``: the last that it will apply without further messages.
    ``is_lost``: its server's state is not known. ``tells``: whether that can be read and written. ``kept_by``: the
    sequencer whose log it follows, if that is not the receiver.
    """

    log: LogId = NO_LOG
    at: int = 0
    held: int = 0
    is_lost: bool = False
    tells: bool = False
    kept_by: Name | None = None

    @property
    def is_fresh(self) -> bool:
        """Return whether its server is as it started."""
        return self.log == NO_LOG and not self.is_lost


class Snapshot(NamedTuple):
    """A server's state after entry ``at``; None: it provides none."""

    log: LogId
    at: int
    state: bytes | None


FollowerMessage: TypeAlias = "ReplicaStatus | Snapshot"


def call_of(log: LogId, index: int) -> int:
    """Return the call number of an entry."""
    return log.incarnation_id << INCARNATION_BITS | index


def place_of(call: int) -> tuple[int, int]:
    """Return the ``incarnation_id`` of a log, and the index in it."""
    return call >> INCARNATION_BITS, call & (1 << INCARNATION_BITS) - 1
