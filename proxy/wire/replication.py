"""Replication messages between the proxies of a service with state. The log's entries travel as requests do.

Sans-I/O. Wire form: version (1) | 0x40 in the position of a part (1) | deterministic CBOR.
Invalid bytes raise ``RemoteError`` (MALFORMED).
"""

from __future__ import annotations

from typing import Final

from gdp.crypto.cbor import Value, decode, encode
from gdp.errors import DropReason, RemoteError
from gdp.limits import MESSAGE_MAX_BYTES
from gdp.names import NAME_BYTES, Name
from gdp.service.frames import VERSION
from gdp.service.replication_messages import (
    AttachReplica,
    FollowerMessage,
    LogId,
    ReplicaProbe,
    ReplicaStatus,
    SequencerMessage,
    Snapshot,
    SnapshotRequest,
)

_WORDS: Final = 0x40  # in the position of a part
_HEAD: Final = bytes([VERSION, _WORDS])
STATE_MAX_BYTES: Final = MESSAGE_MAX_BYTES - 256


def is_word(wire: bytes) -> bool:
    """Return whether these bytes are a replication message, not a request or a response."""
    return wire[: len(_HEAD)] == _HEAD


def to_wire(word: SequencerMessage | FollowerMessage) -> bytes:
    """Return the wire form."""
    said: list[Value]
    match word:
        case ReplicaProbe(incarnation_id):
            said = ["keep", incarnation_id]
        case AttachReplica(log, at, log_before, at_before, state):
            said = ["follow", *log, at, *log_before, at_before, state]
        case SnapshotRequest(log):
            said = ["tell", *log]
        case ReplicaStatus(log, at, held, is_lost, tells, kept_by):
            said = ["position", *log, at, held, is_lost, tells, None if kept_by is None else bytes(kept_by)]
        case Snapshot(log, at, state):
            said = ["state", *log, at, state]
    return _HEAD + encode(said)


def sequencer_message(wire: bytes) -> SequencerMessage:
    """Parse a sequencer's message."""
    match _read(wire):
        case ["keep", int(incarnation_id)]:
            return ReplicaProbe(incarnation_id)
        case [
            "follow",
            int(g),
            int(incarnation_id),
            int(at),
            int(g_before),
            int(life_before),
            int(at_before),
            state,
        ] if state is None or isinstance(state, bytes):
            return AttachReplica(LogId(g, incarnation_id), at, LogId(g_before, life_before), at_before, state)
        case ["tell", int(g), int(incarnation_id)]:
            return SnapshotRequest(LogId(g, incarnation_id))
    raise RemoteError(DropReason.MALFORMED, "a keeper's word")


def follower_message(wire: bytes) -> FollowerMessage:
    """Parse a replica's message."""
    match _read(wire):
        case ["position", int(g), int(incarnation_id), int(at), int(held), bool(is_lost), bool(tells), None]:
            return ReplicaStatus(LogId(g, incarnation_id), at, held, is_lost, tells)
        case ["position", int(g), int(incarnation_id), int(at), int(held), bool(is_lost), bool(tells), bytes(name)] if (
            len(name) == NAME_BYTES
        ):
            return ReplicaStatus(LogId(g, incarnation_id), at, held, is_lost, tells, Name(name))
        case ["state", int(g), int(incarnation_id), int(at), state] if state is None or isinstance(state, bytes):
            return Snapshot(LogId(g, incarnation_id), at, state)
    raise RemoteError(DropReason.MALFORMED, "a replica's word")


def _read(wire: bytes) -> list[Value]:
    said = decode(wire[len(_HEAD) :], MESSAGE_MAX_BYTES)
    if not isinstance(said, list) or any(isinstance(each, int) and each < 0 for each in said):
        raise RemoteError(DropReason.MALFORMED, "a word about a log")
    return said
