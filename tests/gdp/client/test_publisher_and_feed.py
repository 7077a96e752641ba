"""Publisher and its readers over a pipe that loses, doubles and reorders."""

from __future__ import annotations

from os import urandom

import pytest

from gdp.client.publisher import Publisher
from gdp.client.writer_proxy import WriterProxyState
from gdp.crypto.envelope import KeyContext, Sealer
from gdp.errors import DropReason, LocalError
from gdp.frame.codec import Flag, Kind, decode
from gdp.intervals import READER
from gdp.names import Name
from tests.gdp.client.incarnation_ids import reader_of
from tests.gdp.client.pipe import SECRETS, TOPIC, WRITER, Pipe, publisher_of, sequenced

NOTES = (Kind.INTRODUCTION, Kind.ACKNACK)

MESSAGES = [bytes([at % 251]) * (at * 37 % 6_000) for at in range(200)]


@pytest.mark.parametrize("loss", [0.0, 0.01, 0.1, 0.3])
def test_a_reliable_topic_arrives_complete_and_in_order_whatever_is_lost(loss: float) -> None:
    pipe = Pipe(publisher_of())
    pipe.jitter_s, pipe.doubled = 0.003, 0.02
    end = pipe.join(b"a", loss=loss)
    assert pipe.run(30.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    pipe.publish(MESSAGES)
    assert pipe.run(120.0, pipe.publisher.is_acknowledged)
    assert end.messages == MESSAGES
    assert end.writer_proxy.losses.total == 0


@pytest.mark.parametrize("seed", range(20))
def test_messages_published_as_soon_as_a_reader_is_known_are_not_lost_with_the_first_status(seed: int) -> None:
    pipe = Pipe(publisher_of(), seed=seed)
    end = pipe.join(b"a", loss=0.4)
    assert pipe.run(30.0, lambda: pipe.publisher.readers == 1)
    pipe.publish(MESSAGES[:10])
    assert pipe.run(60.0, lambda: len(end.delivered) == 10)
    assert end.messages == MESSAGES[:10]


def test_a_large_message_arrives_over_a_path_that_loses_a_tenth() -> None:
    pipe = Pipe(publisher_of())
    end = pipe.join(b"a", loss=0.1)
    pipe.run(1.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    pipe.publish([b"x" * 921_600])
    assert pipe.run(60.0, pipe.publisher.is_acknowledged)
    assert [len(each) for each in end.messages] == [921_600]


def test_a_best_effort_topic_never_waits_for_what_is_lost() -> None:
    pipe = Pipe(publisher_of(reliable=False))
    end = pipe.join(b"a")
    pipe.run(1.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    for at in range(100):
        end.loss = 1.0 if at % 10 == 3 else 0.0
        before = len(end.delivered)
        pipe.publish([b"m%d" % at])
        pipe.run(0.01)
        assert len(end.delivered) - before == (at % 10 != 3)
    assert end.numbers == sorted(end.numbers)
    assert end.writer_proxy.losses.total == 10
    assert pipe.publisher.protection.repairs == 0


def test_without_a_reader_nothing_is_sealed_and_the_loss_is_counted() -> None:
    publisher = publisher_of()
    assert publisher.publish(b"no reader") is None
    assert publisher.poll_frames(0.0) == []
    assert publisher.drops[DropReason.NO_READER] == 1


@pytest.mark.parametrize("reliable", [True, False])
def test_a_late_joiner_of_a_latched_topic_gets_the_last_messages(reliable: bool) -> None:
    pipe = Pipe(publisher_of(depth=3, reliable=reliable))
    early = pipe.join(b"a")
    pipe.run(1.0, lambda: early.writer_proxy.state is WriterProxyState.LIVE)
    pipe.publish(MESSAGES[:20])
    pipe.run(1.0)
    late = pipe.join(b"b")
    pipe.run(2.0)
    assert early.messages == MESSAGES[:20]
    assert late.messages == MESSAGES[17:20]
    assert late.writer_proxy.losses.total == 0


def test_the_first_reader_of_a_latched_topic_gets_the_last_messages_from_before_it_came() -> None:
    pipe = Pipe(publisher_of(depth=3))
    pipe.publish(MESSAGES[:20])
    end = pipe.join(b"a")
    pipe.run(2.0)
    assert end.messages == MESSAGES[17:20]


def test_a_joiner_between_two_audiences_gets_no_more_than_the_depth() -> None:
    pipe = Pipe(publisher_of(depth=3))
    first = pipe.join(b"a")
    pipe.run(1.0)
    pipe.publish(MESSAGES[:5])
    pipe.run(1.0)
    first.deaf = first.mute = True
    pipe.run(READER.lease_s + 1.0)
    assert pipe.publisher.readers == 0
    del pipe.ends[first.reader.name]
    pipe.publish(MESSAGES[5:7])
    second = pipe.join(b"b")
    pipe.run(2.0)
    assert second.messages == MESSAGES[4:7]


def test_a_dead_reader_is_evicted_after_its_lease_and_delays_no_other_after() -> None:
    pipe = Pipe(publisher_of())
    live, dead = pipe.join(b"a"), pipe.join(b"b")
    pipe.run(1.0)
    dead.deaf = dead.mute = True
    pipe.publish([b"x" * 100_000] * 60)
    assert not pipe.run(READER.lease_s - 2.0, lambda: len(live.delivered) == 60)
    assert pipe.run(4.0, lambda: len(live.delivered) == 60)
    assert pipe.publisher.readers == 1


def test_a_reader_that_reports_but_never_moves_holds_up_the_others_for_one_lease_only() -> None:
    pipe = Pipe(publisher_of())
    live, stuck = pipe.join(b"a"), pipe.join(b"b")
    pipe.run(1.0)
    stuck.deaf = True
    pipe.publish([b"x" * 100_000] * 60)
    assert pipe.run(READER.lease_s + 2.0, lambda: len(live.delivered) == 60)
    begun_s = pipe.now_s
    pipe.publish([b"y" * 100_000] * 60)
    assert pipe.run(3.0, lambda: len(live.delivered) == 120), "held up a second time"
    assert pipe.now_s - begun_s < 3.0


def test_a_reader_that_was_cut_off_for_longer_than_its_lease_goes_on_where_the_publisher_is() -> None:
    pipe = Pipe(publisher_of())
    live, cut = pipe.join(b"a"), pipe.join(b"b")
    pipe.run(1.0)
    pipe.publish([b"before"])
    pipe.run(0.5)
    cut.deaf = cut.mute = True
    for _ in range(20):
        pipe.publish([b"meanwhile"])
        pipe.run(READER.lease_s / 10)
    cut.deaf = cut.mute = False
    pipe.run(20.0)
    cut.loss = 0.3
    pipe.publish([b"after %d" % at for at in range(50)])
    assert pipe.run(30.0, lambda: len(live.delivered) == 71 and cut.messages[-1] == b"after 49")
    assert [each for each in cut.messages if each.startswith(b"after")] == [b"after %d" % at for at in range(50)]
    assert cut.writer_proxy.losses.total == 71 - len(cut.delivered)


def test_a_reader_that_starts_again_is_welcome_and_its_old_notes_are_not() -> None:
    pipe = Pipe(publisher_of())
    first = pipe.join(b"a", incarnation=7)
    pipe.run(1.0)
    old = [frame for frame in pipe.seen if decode(frame).kind == Kind.ACKNACK]
    pipe.publish([b"one"])
    pipe.run(1.0)
    second = pipe.join(b"a", incarnation=8)
    pipe.run(1.0)
    for note in old:
        pipe.publisher.receive_acknack(decode(note), note, pipe.now_s)
    assert pipe.publisher.drops[DropReason.REPLAYED] == len(old)
    pipe.publish([b"two"])
    second.loss = 0.5
    pipe.publish([b"three"] * 20)
    assert pipe.run(30.0, pipe.publisher.is_acknowledged)
    assert first.messages == [b"one"]
    assert second.messages == [b"two"] + [b"three"] * 20


def test_notes_of_two_writer_proxies_of_one_reader_never_share_a_nonce() -> None:
    pipe = Pipe(publisher_of())
    reader = reader_of(b"a")
    pipe.attach(reader)
    pipe.run(1.0)
    pipe.attach(reader)  # its switch lost the publisher and found it again
    pipe.run(1.0)
    notes = [decode(frame) for frame in pipe.seen if decode(frame).kind == Kind.ACKNACK]
    nonces = [(note.source, note.incarnation, note.destination, note.number) for note in notes]
    assert len(set(nonces)) == len(nonces) > 2


def test_a_note_to_one_life_of_a_publisher_is_worth_nothing_to_the_next() -> None:
    pipe = Pipe(publisher_of(incarnation=1))
    pipe.join(b"a")
    pipe.run(1.0)
    notes = {kind: [each for each in pipe.seen if decode(each).kind == kind] for kind in NOTES}
    again = pipe.publisher = publisher_of(incarnation=2)
    pipe.tell(*notes[Kind.INTRODUCTION], *notes[Kind.ACKNACK])
    assert again.readers == 0
    assert again.drops == {
        DropReason.BAD_TAG: len(notes[Kind.INTRODUCTION]),
        DropReason.UNKNOWN_SENDER: len(notes[Kind.ACKNACK]),
    }


def test_a_publisher_that_starts_again_is_another_incarnation() -> None:
    pipe = Pipe(publisher_of(incarnation=1))
    old = pipe.join(b"a")
    pipe.run(1.0)
    pipe.publish([b"first life"])
    pipe.run(1.0)
    pipe.publisher, pipe.incarnation = publisher_of(incarnation=2), 2
    new = pipe.attach(old.reader)
    pipe.run(1.0)
    pipe.publish([b"second life"])
    pipe.run(1.0)
    frame = next(frame for frame in reversed(pipe.seen) if decode(frame).kind == Kind.DATA)
    old.writer_proxy.receive(decode(frame), frame, pipe.now_s, 0.0)
    assert old.messages == [b"first life"]
    assert old.writer_proxy.drops[DropReason.WRONG_INCARNATION] == 1
    assert new.messages == [b"second life"]


def test_an_older_epoch_still_opens_and_an_unknown_one_is_counted() -> None:
    reader_has = {1: b"1" * 32, 2: b"2" * 32}
    pipe = Pipe(publisher_of(secrets=SECRETS))
    end = pipe.join(b"a", secrets=SECRETS)
    pipe.run(1.0)
    end.writer_proxy.renew(reader_has)
    pipe.publish([b"old key"])
    pipe.run(1.0)
    assert end.messages == [b"old key"]
    sealer = Sealer(
        secret=b"2" * 32,
        epoch=2,
        context=KeyContext(Kind.DATA, Name(b"p" * 32), 1, TOPIC),
        signer=WRITER,
        random_bytes=urandom,
    )
    (frame,) = list(sealer.seal(2, Flag.RELIABLE, sequenced(2, b"new key"), 1500))
    end.writer_proxy.receive(decode(frame), frame, pipe.now_s, 0.0)
    assert [each.message for each in end.writer_proxy.delivery.poll()] == [b"new key"]
    sealer = Sealer(
        secret=b"3" * 32,
        epoch=3,
        context=KeyContext(Kind.DATA, Name(b"p" * 32), 1, TOPIC),
        signer=WRITER,
        random_bytes=urandom,
    )
    (frame,) = list(sealer.seal(3, Flag.RELIABLE, sequenced(3, b"strange key"), 1500))
    end.writer_proxy.receive(decode(frame), frame, pipe.now_s, 0.0)
    assert end.writer_proxy.drops[DropReason.UNKNOWN_EPOCH] == 1


def test_nothing_of_the_plaintext_stands_in_any_frame() -> None:
    pipe = Pipe(publisher_of())
    end = pipe.join(b"a", loss=0.1)
    pipe.run(1.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    secret_text = b"the robot stands in hall 217 "
    pipe.publish([secret_text * 300])
    assert pipe.run(30.0, pipe.publisher.is_acknowledged)
    seen = b"\0".join(pipe.seen)
    assert len(seen) > 300 * len(secret_text)
    pieces = {secret_text[at : at + 6] for at in range(len(secret_text) - 6)} | {b"what it is"}
    assert not [piece for piece in pieces if piece in seen]


def test_a_goodbye_gives_the_window_back_at_once() -> None:
    pipe = Pipe(publisher_of())
    end = pipe.join(b"a")
    pipe.run(1.0)
    (note,) = end.writer_proxy.close()
    pipe.publisher.receive_acknack(decode(note), note, pipe.now_s)
    assert pipe.publisher.readers == 0
    assert end.budget.held_bytes == 0


def test_more_readers_than_one_status_holds_all_begin() -> None:
    pipe = Pipe(publisher_of())
    ends = [pipe.join(bytes([at])) for at in range(1, 151)]
    pipe.run(3.0)
    pipe.publish([b"to all"])
    pipe.run(1.0)
    assert all(end.messages == [b"to all"] for end in ends)


def test_a_publisher_without_a_secret_cannot_be() -> None:
    with pytest.raises(LocalError):
        publisher_of(secrets={})


def test_what_no_switch_takes_of_a_best_effort_topic_stays_within_the_window() -> None:
    publisher: Publisher = publisher_of(reliable=False)
    pipe = Pipe(publisher)
    pipe.join(b"a")
    pipe.run(1.0)
    for _ in range(50):
        publisher.publish(bytes(1 << 20))
    frames = publisher.poll_frames(pipe.now_s)
    assert sum(map(len, frames)) <= 32 << 20
    assert publisher.drops[DropReason.MEMORY_FULL] > 0
    assert decode(frames[-1]).number == 50


@pytest.mark.parametrize("reliable", [True, False])
def test_a_new_description_goes_before_what_is_published_behind_it(reliable: bool) -> None:
    pipe = Pipe(publisher_of(reliable=reliable))
    end = pipe.join(b"a")
    assert pipe.run(1.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    publisher = pipe.publisher
    for description in (b"another", b"a third, right behind"):
        publisher.describe(description)
        publisher.publish(bytes(100_000))
        publisher.publish(b"small")
        kinds = [decode(frame).kind for frame in publisher.poll_frames(pipe.now_s)]
        assert kinds.index(Kind.DATA) == kinds.count(Kind.HEARTBEAT) == 1
