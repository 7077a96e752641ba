"""Attacks with control datagrams of readers: in another's name, far ahead, recorded, or of an epoch that is over."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from gdp.client.path_mtu import PLATEAUS, PathMtu
from gdp.client.reader_proxies import READERS_MAX
from gdp.client.writer_proxy import WriterProxyState
from gdp.crypto.control_seal import ControlContext, ControlSealer
from gdp.crypto.envelope import seal_key
from gdp.crypto.introduction import Introduction
from gdp.errors import DropReason
from gdp.frame.codec import Kind, decode
from gdp.limits import EPOCH_GRACE_S, MTU_HOLD_S, MTU_NARROWINGS, NACKS_PER_REPORT
from gdp.message.acknack import AckNack, AckNackFlag, MissingRange
from gdp.message.send_window import SendWindow
from gdp.names import Name
from tests.attacks.work import lines_run
from tests.gdp.client.incarnation_ids import Notes, key_of, name_of, reader_of, subject_of
from tests.gdp.client.pipe import SECRETS, TOPIC, End, Pipe, publisher_of

TWO = {1: b"1" * 32, 2: b"2" * 32}
AHEAD = 60_000
LIES = (
    AckNack(AckNackFlag.NEW, 0, 0, ()),
    AckNack(AckNackFlag.NONE, 1_000, 0, (), 1_000),
    AckNack(AckNackFlag.NONE, 1, 0, (MissingRange(1, 0, 0xFFFF_FFFF),), 1),
    AckNack(AckNackFlag.BYE, 0, 0, ()),
)


def live(pipe: Pipe, label: bytes, incarnation: int = 7) -> End:
    end = pipe.join(label, incarnation=incarnation)
    assert pipe.run(2.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    return end


def notes_of(pipe: Pipe, label: bytes, *, secrets: dict[int, bytes] | None = None, victim: Name | None = None) -> Notes:
    source = pipe.source
    return Notes(reader_of(label), source, TOPIC, SECRETS if secrets is None else secrets, as_name=victim)


def by_the_secret_alone(pipe: Pipe, end: End, number: int, acknack: AckNack) -> bytes:
    """Return the control datagram that proved a reader when the topic's secret alone was sufficient."""
    source, reader = pipe.source, end.reader
    key = seal_key(SECRETS[1], Kind.ACKNACK, reader.name, reader.incarnation, source.name)
    made = ControlSealer(
        key=key,
        epoch=1,
        context=ControlContext(Kind.ACKNACK, reader.name, reader.incarnation, source.name, source.incarnation, TOPIC),
        numbers=iter([number]),
    )
    return made.seal(acknack.to_wire())


def test_a33_a_note_in_another_readers_name_moves_nothing() -> None:
    pipe = Pipe(publisher_of())
    end = live(pipe, b"a")
    insider = notes_of(pipe, b"m", victim=end.reader.name)
    for report in LIES:
        pipe.tell(by_the_secret_alone(pipe, end, AHEAD, report))
        pipe.tell(insider.report(report, incarnation=end.reader.incarnation))
    assert sum(pipe.publisher.drops.values()) == 2 * len(LIES)
    assert set(pipe.publisher.drops) == {DropReason.BAD_TAG, DropReason.REPLAYED, DropReason.MALFORMED}
    assert pipe.publisher.matched.is_read_by(end.reader.name)
    for at in range(80):
        pipe.publish([b"message %d" % at])
        pipe.run(0.1)
    assert end.messages == [b"message %d" % at for at in range(80)]
    assert pipe.publisher.is_acknowledged()


def test_a33_an_introduction_in_another_readers_name_is_refused() -> None:
    pipe = Pipe(publisher_of())
    end = live(pipe, b"a")
    insider = notes_of(pipe, b"m", victim=end.reader.name)
    stranger = reader_of(b"m")
    forged = Introduction.make(subject_of(b"a"), key_of(b"m"), 8, 9_999, stranger.control_keys.public)
    for wire in (None, forged):
        pipe.tell(insider.introduction(wire=wire, incarnation=8))
        pipe.tell(insider.report(LIES[0], incarnation=8))
    assert pipe.publisher.drops[DropReason.UNKNOWN_SENDER] == 2
    assert pipe.publisher.drops[DropReason.WRONG_NAME] + pipe.publisher.drops[DropReason.BAD_SIGNATURE] == 2
    pipe.publish([b"goes on"])
    assert pipe.run(1.0, lambda: end.messages == [b"goes on"])


def test_a33_a_reader_whose_state_was_lost_is_heard_again_at_once() -> None:
    pipe = Pipe(publisher_of())
    live(pipe, b"a")
    again = pipe.join(b"a", incarnation=8)
    assert pipe.run(0.2, lambda: again.writer_proxy.state is WriterProxyState.LIVE)
    pipe.publish([b"for the new life"])
    assert pipe.run(1.0, lambda: again.messages == [b"for the new life"])


def test_a24_a_reader_left_out_of_the_new_epoch_fills_no_quota_and_speaks_for_no_other() -> None:
    pipe = Pipe(publisher_of())
    end = live(pipe, b"a")
    end.writer_proxy.renew(TWO)
    pipe.publisher.renew(TWO, pipe.now_s)
    for at in range(READERS_MAX):
        pipe.tell(*notes_of(pipe, b"left out %d" % at).hello())
    assert pipe.publisher.readers == 1
    insider = notes_of(pipe, b"left out", victim=end.reader.name)
    for report in LIES:
        pipe.tell(insider.report(report, incarnation=end.reader.incarnation))
    pipe.publish([b"under two"])
    assert pipe.run(1.0, lambda: end.messages == [b"under two"] and pipe.publisher.is_acknowledged())


def test_a24_a_reader_that_was_left_out_is_heard_for_a_grace_and_then_no_more() -> None:
    pipe = Pipe(publisher_of())
    live(pipe, b"a")
    pipe.publisher.renew(TWO, pipe.now_s)
    pipe.run(EPOCH_GRACE_S - 1.0)
    assert pipe.publisher.readers == 1
    pipe.run(10.0)
    assert pipe.publisher.readers == 0


def test_a24_a_reader_that_hears_nothing_of_a_new_epoch_during_the_grace_is_a_reader_again_after_it() -> None:
    pipe = Pipe(publisher_of())
    end = live(pipe, b"a")
    end.writer_proxy.renew(TWO)
    end.loss = 1.0
    pipe.publisher.renew(TWO, pipe.now_s)
    pipe.publish([b"one"])
    pipe.run(2 * EPOCH_GRACE_S)
    assert pipe.publisher.readers == 0
    end.loss = 0.0
    assert pipe.run(15.0, lambda: end.messages == [b"one"])


def test_a24_epochs_that_change_all_the_time_lose_nothing() -> None:
    pipe = Pipe(publisher_of(), seed=24)
    ends = [live(pipe, label) for label in (b"a", b"b")]
    ends[1].loss = 0.05
    sent = []
    for epoch in range(2, 12):
        secrets = {epoch - 1: SECRETS[1] if epoch == 2 else bytes([epoch - 1]) * 32, epoch: bytes([epoch]) * 32}
        for end in ends:
            end.writer_proxy.renew(secrets)
        pipe.publisher.renew(secrets, pipe.now_s)
        for at in range(50):
            sent.append(b"%d in %d" % (at, epoch))
            pipe.publish(sent[-1:])
            pipe.run(0.02)
    assert pipe.run(20.0, pipe.publisher.is_acknowledged)
    assert [end.messages for end in ends] == [sent, sent]


def incarnation_ids() -> Iterator[tuple[bytes, int, int]]:
    """Yield reader, its incarnation and the epoch in use, over restarts and new epochs."""
    for epoch in (1, 2, 3):
        for incarnation in (7, 8):
            for label in (b"a", b"b", b"c"):
                yield label, 10 * epoch + incarnation, epoch


def test_a33_no_note_is_accepted_that_is_forged_or_recorded_whatever_restarts() -> None:
    """Every kind of control datagram, forged by other readers and replayed over restarts of both ends and epochs."""
    secrets = {epoch: bytes([epoch]) * 32 for epoch in (1, 2, 3)}
    pipe = Pipe(publisher_of(secrets={1: secrets[1]}))
    recorded: list[bytes] = []
    present: dict[bytes, Notes] = {}
    names = {label: name_of(label) for label in (b"a", b"b", b"c")}
    for turn, (label, incarnation, epoch) in enumerate(incarnation_ids()):
        if pipe.publisher._keys.epoch != epoch:
            pipe.publisher.renew({epoch: secrets[epoch]}, pipe.now_s)
            pipe.now_s += EPOCH_GRACE_S
        if turn == 9:
            pipe.publisher = publisher_of(secrets={epoch: secrets[epoch]}, incarnation=2)
            present.clear()
        reader = reader_of(label, incarnation)
        mine = present[label] = Notes(reader, pipe.source, TOPIC, secrets)
        said = mine.hello(epoch)
        pipe.tell(*said)
        assert pipe.publisher.matched.is_read_by(reader.name), "the genuine life is heard at once"
        for report in LIES[1:3]:
            said.append(mine.report(report, epoch))
            pipe.tell(said[-1])
        recorded += said
        before = snapshot(pipe)
        for other in present.keys() - {label}:
            for incarnation_id in (incarnation, incarnation + 1):
                forger = Notes(reader_of(other, incarnation_id), pipe.source, TOPIC, secrets, as_name=names[label])
                pipe.tell(*forger.hello(epoch), *(forger.report(report, epoch) for report in LIES))
        pipe.tell(*recorded)
        assert snapshot(pipe) == before, f"turn {turn}"
        pipe.now_s += 0.5
    assert set(pipe.publisher.matched.names()) == set(names.values())


def snapshot(pipe: Pipe) -> object:
    """Return the state of a publisher that control datagrams can change."""
    publisher = pipe.publisher
    readers = dict(publisher.matched.active)
    states = {name: (each.incarnation, each.heard_s, each.sequence, each.lost) for name, each in readers.items()}
    return (
        states,
        publisher._window.readers.least(),
        len(publisher._window.readers.active),
        dict(publisher._heartbeats.starts),
    )


def test_a56_a_reader_that_asks_for_everything_costs_a_bounded_share() -> None:
    window = SendWindow()
    reader = b"r" * 32
    window.add_reader(reader, 1, 0.0)
    frames = [bytes(1_000)] * 20_000
    window.add(1, frames, 20_000_000)
    now_s = 0.0
    while window.sent[0] < 2:  # all of it is in flight
        taken = len(window.frames_to_send(now_s))
        part = window.sent[1] if window.sent[0] < 2 else len(frames)
        window.handle_acknack(reader, AckNack(AckNackFlag.NONE, 1, max(part - 1, 0), ()), now_s)
        now_s += 0.01 if taken else 0.1
    everything = tuple(MissingRange(1, 0, 0xFFFF_FFFF) for _ in range(NACKS_PER_REPORT))
    greedy = AckNack(AckNackFlag.NONE, 1, 0, everything)
    for _ in range(200):  # nothing is sent, as over a slow link: all fragments checked are already waiting
        now_s += 0.02
        window.handle_acknack(reader, greedy, now_s)
    with lines_run(2_000_000):  # each of 2,000 reports in a tenth of a second checked 8,192 fragments: 80 million
        for _ in range(2_000):
            now_s += 0.000_05
            window.handle_acknack(reader, greedy, now_s)


@pytest.mark.parametrize("said", [(576, 9_000), tuple(range(8_999, 577, -7))])
def test_a57_a_path_of_every_width_has_kept_messages_sealed_again_a_few_times_only(said: tuple[int, ...]) -> None:
    path, width, narrowed = PathMtu(), 9_000, 0
    path.receive_mtu(width, 0.0)
    for turn in range(1_000):
        now = path.receive_mtu(said[turn % len(said)], turn * MTU_HOLD_S / 1_000)
        if now < width:
            narrowed += 1
            path.count()
        width = now
    assert narrowed <= MTU_NARROWINGS + 1 + len(PLATEAUS)
    assert path.receive_mtu(9_000, 100 * MTU_HOLD_S) == 9_000


def test_a57_a_join_of_a_small_mtu_opens_and_seals_nothing_before_it_is_sent() -> None:
    pipe = Pipe(publisher_of())
    pipe.publisher.tree_stands(9_000)
    end = live(pipe, b"a")
    end.deaf = True
    for _ in range(30):
        pipe.publisher.publish(bytes(1_000_000))
    for _ in range(200):
        pipe.publisher.poll_frames(pipe.now_s)
        pipe.now_s += 0.001
    with lines_run(20_000):
        pipe.publisher.tree_stands(576)
    end.deaf = False
    assert pipe.run(60.0, lambda: len(end.delivered) == 30)
    assert end.messages == [bytes(1_000_000)] * 30


def test_notes_fit_the_smallest_link() -> None:
    pipe = Pipe(publisher_of())
    end = live(pipe, b"a")
    notes = notes_of(pipe, b"b")
    ranges = tuple(MissingRange(1, 0, 1) for _ in range(NACKS_PER_REPORT))
    sizes = [len(notes.introduction()), len(notes.report(AckNack(AckNackFlag.NONE, 1, 0, ranges)))]
    assert max(sizes) <= 576
    assert decode(notes.introduction()).destination == end.writer_proxy.publisher
