"""Renumbering: messages that no longer fit the path are fragmented again, and stay single and in order at readers."""

from __future__ import annotations

from random import Random

import pytest

from gdp.frame.codec import Kind, decode
from tests.gdp.client.pipe import End, Pipe, publisher_of
from tests.lanes import nightly

WIDE, NARROW = 9_000, 800


def messages(count: int, seed: int = 1) -> list[bytes]:
    chance = Random(seed)
    return [at.to_bytes(2, "big") + chance.randbytes(chance.choice((10, 700, 5_000, 40_000))) for at in range(count)]


def wide(*, depth: int = 0, seed: int = 1) -> Pipe:
    publisher = publisher_of(depth=depth)
    publisher.tree_stands(WIDE)
    return Pipe(publisher, seed=seed)


def joined(pipe: Pipe, *names: bytes) -> list[End]:
    ends = [pipe.join(name) for name in names]
    assert pipe.run(2, lambda: pipe.publisher.readers == len(names))
    pipe.run(0.1)
    return ends


def narrow(pipe: Pipe, *ends: End, mtu: int = NARROW) -> None:
    for end in ends:
        end.mtu = mtu
    pipe.publisher.tree_stands(mtu)


def test_what_is_under_way_when_the_path_narrows_arrives_once_and_in_order() -> None:
    pipe = wide()
    one, other = joined(pipe, b"a", b"b")
    sent = messages(20)
    pipe.publish(sent)
    pipe.run(0.003)
    narrow(pipe, one)
    assert pipe.run(5, pipe.publisher.is_acknowledged)
    assert one.messages == other.messages == sent
    assert one.writer_proxy.losses.total == other.writer_proxy.losses.total == 0


def test_numbers_still_rise() -> None:
    pipe = wide()
    (one,) = joined(pipe, b"a")
    pipe.publish(messages(20))
    pipe.run(0.003)
    narrow(pipe, one)
    assert pipe.run(5, pipe.publisher.is_acknowledged)
    assert one.numbers == sorted(set(one.numbers))


def test_no_number_is_sealed_twice() -> None:
    pipe = wide()
    (one,) = joined(pipe, b"a")
    pipe.publish(messages(20))
    pipe.run(0.003)
    narrow(pipe, one)
    pipe.run(5, pipe.publisher.is_acknowledged)
    frames: dict[tuple[int, int, int], bytes] = {}
    for frame in pipe.seen:
        header = decode(frame)
        if header.kind == Kind.DATA:
            assert frames.setdefault((header.epoch, header.number, header.part), frame) == frame


def test_what_fits_keeps_its_number() -> None:
    pipe = wide()
    (one,) = joined(pipe, b"a")
    pipe.publish([b"small"] * 3)
    narrow(pipe, one)
    pipe.publish([b"small"] * 3)
    assert pipe.run(5, pipe.publisher.is_acknowledged)
    assert one.numbers == [1, 2, 3, 4, 5, 6]


def test_confirmed_messages_are_counted_and_not_their_numbers() -> None:
    pipe = wide()
    (one,) = joined(pipe, b"a")
    for _ in range(3):
        pipe.publisher.tree_stands(WIDE)
        one.mtu = WIDE
        pipe.publish(messages(10))
        pipe.run(0.003)
        narrow(pipe, one)
        assert pipe.run(5, pipe.publisher.is_acknowledged)
    assert pipe.publisher.acknowledgements.acknowledged == pipe.publisher.messages == len(one.messages) == 30


def test_a_late_joiner_gets_latched_messages_in_the_new_size_and_no_reader_gets_them_again() -> None:
    pipe = wide(depth=3)
    (one,) = joined(pipe, b"a")
    sent = messages(10)
    pipe.publish(sent)
    assert pipe.run(5, pipe.publisher.is_acknowledged)
    pipe.run(1)
    late = pipe.join(b"b")
    narrow(pipe, late)
    assert pipe.run(5, lambda: len(late.messages) == 3)
    pipe.run(3)
    assert (late.messages, one.messages) == (sent[-3:], sent)


def test_a_reader_that_missed_several_moves_follows_them_all() -> None:
    pipe = wide()
    one, other = joined(pipe, b"a", b"b")
    sent = messages(10)
    other.deaf = True
    pipe.publish(sent)
    for mtu in (4_000, 2_000, 1_000, 600):
        pipe.run(0.2)
        narrow(pipe, one, other, mtu=mtu)
    pipe.run(0.2)
    other.deaf = False
    assert pipe.run(5, pipe.publisher.is_acknowledged)
    assert one.messages == other.messages == sent


@pytest.mark.parametrize("seed", [*range(4), *nightly(*range(4, 8))])
def test_whatever_is_lost_or_overtakes_while_paths_change_all_arrives_once_and_in_order(seed: int) -> None:
    pipe, chance = wide(seed=seed), Random(seed)
    ends = joined(pipe, b"a", b"b", b"c")
    pipe.jitter_s, pipe.doubled = 0.004, 0.1
    for end in ends:
        end.loss = 0.1
    sent = messages(60, seed)
    for at, message in enumerate(sent):
        pipe.publish([message])
        pipe.run(chance.random() * 0.01)
        if at % 6 == 5:
            mtu = chance.choice((600, NARROW, 1_500, 4_000, WIDE))
            chance.choice(ends).mtu = mtu
            pipe.run(chance.random() * 0.02)
            pipe.publisher.tree_stands(min(end.mtu for end in ends))
    assert pipe.run(20, pipe.publisher.is_acknowledged)
    assert [end.messages == sent for end in ends] == [True, True, True]
