"""Words about a log: what is written is read back, and arbitrary bytes are read or refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import RemoteError
from gdp.names import Name
from gdp.service.ordered import Follow, FollowerWord, Keep, KeeperWord, Log, Position, State, Tell
from proxy.exchange import Answer, Outcome, Request, Stop
from proxy.ordering import follower_word, is_word, keeper_word, to_wire

LOG = Log(3, 0xFFFF_FFFF)


@pytest.mark.parametrize(
    "word", [Keep(7), Follow(LOG, 5, Log(2, 1), 4, None), Follow(LOG, 5, LOG, 9, b"state"), Tell(LOG)]
)
def test_a_keepers_word_travels(word: KeeperWord) -> None:
    assert is_word(to_wire(word))
    assert keeper_word(to_wire(word)) == word


@pytest.mark.parametrize(
    "word",
    [
        Position(),
        Position(LOG, 5, 9, tells=True),
        Position(is_lost=True, kept_by=Name(bytes(range(32)))),
        State(LOG, 1, None),
        State(LOG, 1, b"x" * 5_000),
    ],
)
def test_a_replicas_word_travels(word: FollowerWord) -> None:
    assert is_word(to_wire(word))
    assert follower_word(to_wire(word)) == word


def test_what_else_travels_is_no_word() -> None:
    for wire in (Request(0, 1, 2, b"x"), Answer(0, 1, Outcome.ANSWERED, b"x"), Stop(0, (1,))):
        assert not is_word(wire.to_wire())


@given(st.binary(max_size=80))
def test_arbitrary_bytes_are_read_or_refused(body: bytes) -> None:
    for read in (keeper_word, follower_word):
        try:
            word = read(b"\1\x40" + body)
        except RemoteError:
            continue
        assert to_wire(word) == b"\1\x40" + body
