"""Requests in one order for services that keep state: the log, where a replica stands in it, and who says what.

Place: pure.
Source: state machine replication (Schneider, ACM Computing Surveys 22(4), 1990), with the client's side as the one that
orders. No majority is asked: an answer is given once one replica has it, as for services without state.

The client's proxy keeps the log, ``keeper.py``; each replica's proxy follows it, ``follower.py``::

    keeper                                        follower
    Keep      where are you? my log is ...   ->
                                             <-   Position
    Follow    my log from here on, perhaps   ->
              with this state
                                             <-   Position
    entries, by the tree or again to one     ->
                                             <-   an answer to each
    Tell      what is your state?            ->
                                             <-   State
"""

from __future__ import annotations

from typing import Final, NamedTuple, TypeAlias

from gdp.names import Name

__all__ = [
    "LIFE_BITS",
    "NO_LOG",
    "AttachReplica",
    "FollowerMessage",
    "LogId",
    "ReplicaCommand",
    "ReplicaProbe",
    "ReplicaStatus",
    "SequencerMessage",
    "Snapshot",
    "SnapshotRequest",
    "call_of",
    "place_of",
]

LIFE_BITS: Final = 32  # the upper half of a call's number says which log, the lower which entry


class LogId(NamedTuple):
    """A log. Of two the greater holds.

    ``generation``: above that of every log its keeper heard of. ``life``: 32 random bits, for two that began at once.
    """

    generation: int
    life: int


NO_LOG: Final = LogId(0, 0)  # of a server that has just started


class ReplicaProbe(NamedTuple):
    """A keeper's question where a replica is; one that followed another log of its is free by that."""

    life: int


class AttachReplica(NamedTuple):
    """A keeper's word that a replica stands after entry ``at`` of its log.

    ``state``: which the replica is to take on first. None: it has it, if it is where ``log_before`` and ``at_before``
    say.
    """

    log: LogId
    at: int
    log_before: LogId
    at_before: int
    state: bytes | None


class SnapshotRequest(NamedTuple):
    """A keeper's question for a replica's state."""

    log: LogId


SequencerMessage: TypeAlias = "ReplicaProbe | AttachReplica | SnapshotRequest"


class ReplicaCommand(NamedTuple):
    """What a keeper tells one replica."""

    server: Name
    word: SequencerMessage


class ReplicaStatus(NamedTuple):
    """Where a replica is.

    ``at``: the last entry that its server has done; ``held``: the last that it will do without hearing more.
    ``is_lost``: what state its server is in is not known. ``tells``: whether that can be read and written.
    ``kept_by``: whose log it follows, if that is not who hears this.
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
    """A server's state after entry ``at``; None: it does not tell."""

    log: LogId
    at: int
    state: bytes | None


FollowerMessage: TypeAlias = "ReplicaStatus | Snapshot"


def call_of(log: LogId, index: int) -> int:
    """Return the number under which an entry travels."""
    return log.life << LIFE_BITS | index


def place_of(call: int) -> tuple[int, int]:
    """Return the life of a log, and the index in it."""
    return call >> LIFE_BITS, call & (1 << LIFE_BITS) - 1
