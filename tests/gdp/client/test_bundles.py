"""Bundles: small messages that wait together go under one seal, and every count still counts messages."""

from __future__ import annotations

from os import urandom

import pytest

from gdp.client import best_effort_queue
from gdp.client.publisher import Publisher
from gdp.client.sequence_numbers import SequenceState
from gdp.crypto.envelope import SIGNATURE_BYTES, KeyContext, Sealer, fragment_capacity
from gdp.errors import DropReason, LocalError
from gdp.frame.codec import Flag, Header, Kind, decode
from gdp.limits import MESSAGE_MAX_BYTES, WINDOW_BYTES
from gdp.message.bundle import BUNDLE_BYTES, pack
from gdp.names import Name
from tests.gdp.client.incarnation_ids import source_of
from tests.gdp.client.pipe import SECRETS, TOPIC, WRITER, End, Pipe, publisher_of, sequenced

SMALL = [b"%d " % at * (at % 40) for at in range(2_000)]


def live(publisher: Publisher, *names: bytes) -> tuple[Pipe, list[End]]:
    pipe = Pipe(publisher)
    ends = [pipe.join(name) for name in names or (b"a",)]
    assert pipe.run(2.0, lambda: publisher.readers == len(ends))
    pipe.run(0.1)
    pipe.seen.clear()
    return pipe, ends


def publish(publisher: Publisher, messages: list[bytes]) -> None:
    for message in messages:
        publisher.publish(message)


def data(pipe: Pipe) -> list[Header]:
    headers = [decode(frame) for frame in pipe.seen]
    return [header for header in headers if header.kind == Kind.DATA]


@pytest.mark.parametrize("loss", [0.0, 0.1])
@pytest.mark.parametrize("reliable", [True, False])
def test_messages_that_wait_together_come_in_order_under_few_numbers(reliable: bool, loss: float) -> None:
    pipe, (end,) = live(publisher_of(reliable=reliable))
    end.loss = loss
    publish(pipe.publisher, SMALL)
    pipe.run(3.0)
    places = [(each.number, each.place) for each in end.delivered]
    assert places == sorted(set(places))
    assert len({header.number for header in data(pipe)}) < len(SMALL) / 10
    if reliable or not loss:
        assert end.messages == SMALL
        assert (
            pipe.publisher.acknowledgements.acknowledged
            == pipe.publisher.messages
            == end.writer_proxy.delivery.delivered
            == len(SMALL)
        )


def test_a_message_alone_is_sealed_alone_and_at_once() -> None:
    pipe, _ = live(publisher_of())
    for at in range(3):
        pipe.publish([b"alone"])
        assert len(data(pipe)) == at + 1
    assert not any(header.flags & Flag.BUNDLE for header in data(pipe))


def test_a_bundle_is_bounded_and_that_of_a_best_effort_topic_is_one_frame() -> None:
    for reliable, bound in ((True, -(-(BUNDLE_BYTES + SIGNATURE_BYTES) // fragment_capacity(1_500))), (False, 1)):
        pipe, _ = live(publisher_of(reliable=reliable))
        publish(pipe.publisher, SMALL)
        pipe.run(1.0)
        bundles = [header for header in data(pipe) if header.flags & Flag.BUNDLE]
        assert max(header.parts for header in bundles) == bound


def test_a_large_message_goes_alone_and_keeps_its_place_between_small_ones() -> None:
    pipe, (end,) = live(publisher_of())
    sent = [*SMALL[:50], bytes(BUNDLE_BYTES // 2), *SMALL[50:100], bytes(100_000), b"", b"last"]
    publish(pipe.publisher, sent)
    assert pipe.run(2.0, pipe.publisher.is_acknowledged)
    assert end.messages == sent
    assert len({header.number for header in data(pipe)}) == 5


@pytest.mark.parametrize("reliable", [True, False])
def test_a_latched_topic_has_no_bundles_so_that_late_joiners_get_so_many_messages(reliable: bool) -> None:
    pipe, (early,) = live(publisher_of(depth=3, reliable=reliable))
    publish(pipe.publisher, SMALL[:20])
    pipe.run(1.0)
    late = pipe.join(b"b")
    pipe.run(2.0)
    assert (early.messages, late.messages) == (SMALL[:20], SMALL[17:20])


def test_without_space_for_bundles_each_message_has_its_own_seal() -> None:
    pipe, (end,) = live(publisher_of())
    pipe.publisher.queue.bundle_bytes = 0
    publish(pipe.publisher, SMALL[:100])
    assert pipe.run(1.0, pipe.publisher.is_acknowledged)
    assert end.numbers == list(range(1, 101))
    assert end.messages == SMALL[:100]


@pytest.mark.parametrize("reliable", [True, False])
def test_no_other_path_or_depth_brings_bundles_where_there_is_no_space_for_them(reliable: bool) -> None:
    pipe, (end,) = live(publisher_of(reliable=reliable))
    pipe.publisher.queue.bundle_bytes = 0
    pipe.publisher.tree_stands(9_000)
    pipe.publisher.set_depth(3)
    pipe.publisher.set_depth(0)
    publish(pipe.publisher, SMALL[:20])
    pipe.run(1.0)
    assert end.numbers == list(range(1, 21))
    assert end.messages == SMALL[:20]


def test_what_waits_for_its_seal_is_not_for_a_reader_that_comes_later() -> None:
    pipe, (end,) = live(publisher_of())
    publish(pipe.publisher, SMALL[:10])
    late = pipe.join(b"b")
    pipe.tell(*late.writer_proxy.control_to_send(pipe.now_s))
    publish(pipe.publisher, SMALL[10:20])
    pipe.run(2.0)
    assert (end.messages, late.messages) == (SMALL[:20], SMALL[10:20])
    assert late.writer_proxy.losses.total == 0


def test_what_publish_returns_is_confirmed_when_so_many_are() -> None:
    pipe, _ = live(publisher_of())
    numbers = [pipe.publisher.publish(message) for message in SMALL[:30]]
    pipe.run(0.001)
    assert pipe.publisher.acknowledgements.acknowledged == 0
    assert not pipe.publisher.is_acknowledged()
    numbers += [pipe.publisher.publish(message) for message in SMALL[:30]]
    assert pipe.run(1.0, pipe.publisher.is_acknowledged)
    assert numbers == list(range(1, 61))
    assert pipe.publisher.acknowledgements.acknowledged == 60


def test_a_message_above_the_limit_is_refused_and_what_waited_before_it_goes() -> None:
    pipe, (end,) = live(publisher_of())
    publish(pipe.publisher, SMALL[:3])
    with pytest.raises(LocalError):
        pipe.publisher.publish(bytes(MESSAGE_MAX_BYTES + 1))
    publish(pipe.publisher, SMALL[3:6])
    assert pipe.run(1.0, pipe.publisher.is_acknowledged)
    assert end.messages == SMALL[:6]
    assert pipe.publisher.acknowledgements.acknowledged == pipe.publisher.messages == 6


@pytest.mark.parametrize("reliable", [True, False])
def test_undelivered_messages_are_bounded_in_memory_and_evictions_are_counted_in_messages(
    reliable: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(best_effort_queue, "WINDOW_BYTES", WINDOW_BYTES // 8)  # of small messages there are many
    publisher = publisher_of(reliable=reliable)
    pipe, (end,) = live(publisher)
    message, count = bytes(10_000 if reliable else 300), 0
    while not publisher.drops[DropReason.MEMORY_FULL]:
        assert count * len(message) < 4 * WINDOW_BYTES
        publish(publisher, [message] * 50)
        count += 50
    assert not publisher.has_space() or not reliable
    end.loss = 0.0
    pipe.run(60.0, publisher.is_acknowledged)
    assert len(end.delivered) + publisher.drops[DropReason.MEMORY_FULL] == count == publisher.messages
    assert publisher.has_space()


@pytest.mark.parametrize("reliable", [True, False])
def test_bundles_that_no_longer_fit_the_path_are_bundles_under_their_new_numbers(reliable: bool) -> None:
    publisher = publisher_of(reliable=reliable)
    publisher.tree_stands(9_000)
    pipe, (end, other) = live(publisher, b"a", b"b")
    for at in range(0, len(SMALL), 200):
        publish(publisher, SMALL[at : at + 200])
        publisher.publish(bytes(20_000))
        if reliable:
            pipe.run(0.003)
            end.mtu = 9_000 if at % 400 else 700
        publisher.tree_stands(9_000 if at % 400 else 700)
    assert pipe.run(20.0, publisher.is_acknowledged)
    pipe.run(1.0)
    assert [each for each in end.messages if len(each) < 20_000] == SMALL
    assert end.messages == other.messages
    assert publisher.acknowledgements.acknowledged == publisher.messages == len(end.messages)
    # numbers that were sealed but never sent look like a loss
    assert end.writer_proxy.losses.total == 0 or not reliable


@pytest.mark.parametrize("body", [b"", pack([b"x"]) + b"y", pack([b"x" * 9])[:-1]], ids=["empty", "trailing", "cut"])
def test_a_bundle_that_is_not_exact_is_counted_and_nothing_of_it_delivered(body: bytes) -> None:
    pipe, (end,) = live(publisher_of())
    sealer = Sealer(
        secret=SECRETS[1],
        epoch=1,
        context=KeyContext(Kind.DATA, Name(b"p" * 32), 1, TOPIC),
        signer=WRITER,
        random_bytes=urandom,
    )
    for number, message, flags in ((1, body, Flag.RELIABLE | Flag.BUNDLE), (2, b"next", Flag.RELIABLE)):
        for frame in sealer.seal(number, int(flags), sequenced(number, message), 1_500):
            end.writer_proxy.receive(decode(frame), frame, pipe.now_s, 0.0)
    assert [each.message for each in end.writer_proxy.delivery.poll()] == [b"next"]
    drops = end.writer_proxy.drops
    assert drops[DropReason.MALFORMED] + drops[DropReason.TRUNCATED] == 1


def test_a_bundle_that_is_lost_counts_as_a_loss() -> None:
    pipe, (end,) = live(publisher_of(reliable=False))
    end.loss = 1.0
    publish(pipe.publisher, [b"gone"] * 5)
    pipe.run(0.01)
    end.loss = 0.0
    publish(pipe.publisher, [b"here"] * 5)
    pipe.run(0.1)
    assert end.messages == [b"here"] * 5
    assert 1 <= end.writer_proxy.losses.total <= 5


def test_a_publisher_that_goes_on_where_another_ended_bundles_and_counts_from_its_own_first_message() -> None:
    source = source_of(Name(b"p" * 32), 1, WRITER)
    publisher = Publisher(
        topic=TOPIC, source=source, secrets=SECRETS, description=b"again", past=SequenceState(1_000, 50)
    )
    publisher.tree_stands(1_500)
    pipe, (end,) = live(publisher)
    publish(publisher, SMALL[:300])
    assert pipe.run(1.0, publisher.is_acknowledged)
    assert end.messages == SMALL[:300]
    assert min(end.numbers) == 1_000
    assert publisher.acknowledgements.acknowledged == 300


def test_a_topic_that_becomes_latched_bundles_no_more_and_one_that_is_no_longer_does_again() -> None:
    pipe, (end,) = live(publisher_of())
    for depth, begin in ((0, 0), (3, 100), (0, 200)):
        pipe.publisher.set_depth(depth)
        publish(pipe.publisher, SMALL[begin : begin + 100])
        pipe.seen.clear()
        assert pipe.run(1.0, pipe.publisher.is_acknowledged)
        assert any(header.flags & Flag.BUNDLE for header in data(pipe)) == (depth == 0)
    assert end.messages == SMALL[:300]
    assert pipe.publisher.acknowledgements.acknowledged == 300
