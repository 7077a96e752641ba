"""Messages of replication: each reads back as written, and arbitrary bytes are read or refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import RemoteError
from gdp.names import Name
from gdp.service.frames import Answer, Outcome, Request, Stop
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
from proxy.wire.replication import follower_message, is_word, sequencer_message, to_wire

LOG = LogId(3, 0xFFFF_FFFF)


@pytest.mark.parametrize(
    "word",
    [
        ReplicaProbe(7),
        AttachReplica(LOG, 5, LogId(2, 1), 4, None),
        AttachReplica(LOG, 5, LOG, 9, b"state"),
        SnapshotRequest(LOG),
    ],
)
def test_a_sequencer_message_survives_the_wire(word: SequencerMessage) -> None:
    assert is_word(to_wire(word))
    assert sequencer_message(to_wire(word)) == word


@pytest.mark.parametrize(
    "word",
    [
        ReplicaStatus(),
        ReplicaStatus(LOG, 5, 9, tells=True),
        ReplicaStatus(is_lost=True, kept_by=Name(bytes(range(32)))),
        Snapshot(LOG, 1, None),
        Snapshot(LOG, 1, b"x" * 5_000),
    ],
)
def test_a_replicas_word_travels(word: FollowerMessage) -> None:
    assert is_word(to_wire(word))
    assert follower_message(to_wire(word)) == word


def test_what_else_travels_is_no_word() -> None:
    for wire in (Request(0, 1, 2, b"x"), Answer(0, 1, Outcome.ANSWERED, b"x"), Stop(0, (1,))):
        assert not is_word(wire.to_wire())


@given(st.binary(max_size=80))
def test_arbitrary_bytes_are_read_or_refused(body: bytes) -> None:
    for read in (sequencer_message, follower_message):
        try:
            word = read(b"\1\x40" + body)
        except RemoteError:
            continue
        assert to_wire(word) == b"\1\x40" + body
