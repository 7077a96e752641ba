"""Hostile members of a topic: they hold its secret, and must neither stall nor flood the others."""

from __future__ import annotations

from os import urandom

import pytest

from gdp.client.writer_proxy import WriterProxyState
from gdp.crypto.envelope import KeyContext, Sealer, Signer
from gdp.crypto.keys import SigningKey
from gdp.errors import DropReason
from gdp.frame.codec import Flag, Kind, decode
from gdp.limits import JOIN_PATIENCE_S, JOIN_SOURCE_BYTES, JOIN_TOTAL_BYTES, NACKS_PER_REPORT
from gdp.message.acknack import AckNack, AckNackFlag, MissingRange
from gdp.message.heartbeat import Heartbeat
from gdp.message.renumbering import Renumbering
from gdp.names import Name
from tests.gdp.client.incarnation_ids import Notes, reader_of
from tests.gdp.client.pipe import SECRETS, TOPIC, WRITER, End, Pipe, publisher_of, sequenced

pytestmark = pytest.mark.real_signatures
PUBLISHER = Name(b"p" * 32)
MALLORY = SigningKey.generate()


def forge(
    number: int, message: bytes, *, kind: Kind = Kind.DATA, signer: Signer = MALLORY, mtu: int = 1500
) -> list[bytes]:
    """Return messages that a reader can make: fragments that open, under a signature that is not the writer's."""
    sealer = Sealer(
        secret=SECRETS[1], epoch=1, context=KeyContext(kind, PUBLISHER, 1, TOPIC), signer=signer, random_bytes=urandom
    )
    return list(sealer.seal(number, Flag.RELIABLE, message, mtu))


def give(pipe: Pipe, end: End, frames: list[bytes]) -> None:
    for frame in frames:
        end.writer_proxy.receive(decode(frame), frame, pipe.now_s, 0.0)


def notes_of(pipe: Pipe, label: bytes, reports: list[AckNack]) -> list[bytes]:
    notes = Notes(reader_of(label), pipe.source, TOPIC, SECRETS)
    return [notes.introduction(), *(notes.report(each) for each in reports)]


def live() -> tuple[Pipe, End]:
    pipe = Pipe(publisher_of())
    end = pipe.join(b"a")
    assert pipe.run(2.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    return pipe, end


def test_forged_parts_under_the_next_number_delay_a_reliable_message_but_do_not_lose_it() -> None:
    pipe, end = live()
    give(pipe, end, forge(1, bytes(50_000))[:5])
    pipe.publish([b"r" * 9_000, b"s"])
    assert pipe.run(JOIN_PATIENCE_S + 2.0, pipe.publisher.is_acknowledged)
    assert end.messages == [b"r" * 9_000, b"s"]


def test_a_forged_part_far_ahead_does_not_make_a_reader_ask_for_ever() -> None:
    pipe, end = live()
    give(pipe, end, forge(10_000, bytes(5_000))[:1])
    pipe.run(JOIN_PATIENCE_S + 1.0)
    pipe.seen.clear()
    pipe.run(10.0)
    assert len(pipe.seen) < 15
    pipe.publish([b"real"])
    assert pipe.run(1.0, lambda: end.messages == [b"real"])


def test_forged_parts_do_not_keep_best_effort_messages_from_being_repaired() -> None:
    pipe = Pipe(publisher_of(reliable=False))
    end = pipe.join(b"a")
    assert pipe.run(2.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    for number in (2, *range(1_000, 1_100)):
        give(pipe, end, forge(number, bytes(50_000))[7:8])
    end.loss = 0.05
    for at in range(30):
        pipe.publish([b"%02d" % at + bytes(20_000)])
        pipe.run(0.05)
    pipe.run(1.0)
    assert len(end.delivered) >= 29
    assert end.numbers == sorted(end.numbers)
    pipe.seen.clear()
    pipe.run(10.0)
    assert len(pipe.seen) < 15


def test_absurd_numbers_before_the_first_status_do_not_stop_a_writer_proxy() -> None:
    pipe = Pipe(publisher_of())
    end = pipe.join(b"a")
    end.mute = True
    give(pipe, end, forge(1 << 63, b"x", signer=WRITER))
    give(pipe, end, forge((1 << 63) + 1, bytes(5_000))[:1])
    give(pipe, end, forge((1 << 63) + 1, bytes(5_000), kind=Kind.HEARTBEAT)[:1])
    pipe.run(JOIN_PATIENCE_S + 1.0)
    end.mute = False
    pipe.run(1.0)
    pipe.publish([b"one", b"two"])
    assert pipe.run(2.0, lambda: end.messages == [b"one", b"two"])
    assert end.writer_proxy.losses.total == 0


def test_messages_that_come_before_the_first_status_are_kept_within_bounds() -> None:
    pipe = Pipe(publisher_of())
    end = pipe.join(b"a")
    sealer = Sealer(
        secret=SECRETS[1],
        epoch=1,
        context=KeyContext(Kind.DATA, PUBLISHER, 1, TOPIC),
        signer=WRITER,
        random_bytes=urandom,
    )
    for number in range(1, 80):
        give(pipe, end, list(sealer.seal(number, Flag.RELIABLE, sequenced(number, bytes(1 << 20)), 65_000)))
        assert end.budget.held_bytes <= JOIN_SOURCE_BYTES
    assert end.writer_proxy.drops[DropReason.MEMORY_FULL] > 0
    end.writer_proxy.close()
    assert end.budget.held_bytes == 0


def test_messages_behind_a_gap_that_is_never_filled_are_kept_within_bounds() -> None:
    pipe, end = live()
    sealer = Sealer(
        secret=SECRETS[1],
        epoch=1,
        context=KeyContext(Kind.DATA, PUBLISHER, 1, TOPIC),
        signer=WRITER,
        random_bytes=urandom,
    )
    for number in range(2, 80):
        give(pipe, end, list(sealer.seal(number, Flag.RELIABLE, sequenced(number, bytes(1 << 20)), 65_000)))
        assert end.budget.held_bytes <= JOIN_TOTAL_BYTES
    assert [each.number for each in end.writer_proxy.delivery.poll()][:3] == [2, 3, 4]
    assert end.writer_proxy.losses.total == 1


def test_a_status_of_giant_numbers_costs_a_report_of_the_usual_size() -> None:
    pipe, end = live()
    status = Heartbeat(0, (1 << 64) - 1, 0, {}, b"").to_wire()
    give(pipe, end, forge(500, status, kind=Kind.HEARTBEAT, signer=WRITER))
    (report,) = end.writer_proxy.control_to_send(pipe.now_s)
    assert len(report) < 3_000
    pipe.publish([b"still here"])
    assert pipe.run(1.0, lambda: end.messages == [b"still here"])


def test_a_status_whose_oldest_is_giant_ends_its_own_writer_proxy_and_no_more() -> None:
    pipe, end = live()
    status = Heartbeat((1 << 64) - 2, (1 << 64) - 1, 0, {}, b"").to_wire()
    give(pipe, end, forge(500, status, kind=Kind.HEARTBEAT, signer=WRITER))
    pipe.publish([b"x"])
    pipe.run(2.0)
    assert end.messages == []
    assert end.writer_proxy.drops[DropReason.LATE] > 0


@pytest.mark.parametrize("reliable", [Flag.RELIABLE, Flag.NONE])
def test_a_message_whose_number_has_no_next_is_refused_and_ends_no_reader(reliable: Flag) -> None:
    pipe, end = live()
    status = Heartbeat((1 << 64) - 2, (1 << 64) - 1, 0, {}, b"").to_wire()
    give(pipe, end, forge(500, status, kind=Kind.HEARTBEAT, signer=WRITER))
    for number in ((1 << 64) - 2, (1 << 64) - 1):
        sealer = Sealer(
            secret=SECRETS[1],
            epoch=1,
            context=KeyContext(Kind.DATA, PUBLISHER, 1, TOPIC),
            signer=WRITER,
            random_bytes=urandom,
        )
        give(pipe, end, list(sealer.seal(number, reliable, sequenced(number, b"last"), 1_500)))
    assert end.writer_proxy.control_to_send(pipe.now_s) != []
    assert end.writer_proxy.drops[DropReason.MALFORMED] == 1


def test_a_move_beyond_all_numbers_is_refused() -> None:
    pipe, end = live()
    move = Renumbering(0, (1 << 64) - 3, (1 << 64) - 1)
    status = Heartbeat(0, 0, 0, {}, b"", (move,)).to_wire()
    give(pipe, end, forge(500, status, kind=Kind.HEARTBEAT, signer=WRITER))
    assert end.writer_proxy.drops[DropReason.MALFORMED] == 1
    pipe.publish([b"still here"])
    assert pipe.run(1.0, lambda: end.messages == [b"still here"])


def test_a_signed_status_that_makes_no_sense_is_counted() -> None:
    pipe, end = live()
    give(pipe, end, forge(500, b"\xff" * 40, kind=Kind.HEARTBEAT, signer=WRITER))
    assert end.writer_proxy.drops[DropReason.MALFORMED] == 1


def test_a_reader_that_asks_for_everything_again_and_again_gets_a_flight_in_a_round_trip() -> None:
    pipe = Pipe(publisher_of(depth=40))
    honest = pipe.join(b"a")
    pipe.run(1.0)
    pipe.publish([bytes(500_000)] * 40)
    assert pipe.run(30.0, lambda: len(honest.delivered) == 40)
    everything = tuple(MissingRange(number, 0, 0xFFFF_FFFF) for number in range(1, NACKS_PER_REPORT))
    greedy = [AckNack(AckNackFlag.NEW, 0, 0, ())] + [AckNack(AckNackFlag.NONE, 1, 0, everything)] * 400
    sent = 0
    begun_s = pipe.now_s
    for note in notes_of(pipe, b"m", greedy):
        pipe.tell(note)
        sent += sum(map(len, pipe.publisher.poll_frames(pipe.now_s)))
        pipe.now_s += 0.0001
    rounds = (pipe.now_s - begun_s) / 0.01 + 1
    assert sent <= rounds * (4 << 20)
    assert sent < 20_000_000  # unbounded it would be as much for each of 400 reports


def test_readers_that_say_they_are_new_again_and_again_get_one_status_in_a_while() -> None:
    pipe, _ = live()
    sent = []
    for note in notes_of(pipe, b"m", [AckNack(AckNackFlag.NEW, 0, 0, ())] * 1_000):
        pipe.tell(note)
        sent += pipe.publisher.poll_frames(pipe.now_s)
    assert len(sent) <= 1


def test_more_names_than_the_publisher_takes_are_refused() -> None:
    pipe, end = live()
    for at in range(1_100):
        pipe.tell(*notes_of(pipe, at.to_bytes(32, "big"), [AckNack(AckNackFlag.NEW, 0, 0, ())]))
    assert pipe.publisher.readers == 1_024
    assert pipe.publisher.drops[DropReason.QUOTA] == 77
    pipe.publish([b"goes on"])
    assert pipe.run(10.0, lambda: end.messages == [b"goes on"])


def test_what_an_outsider_sends_leaves_nothing_behind() -> None:
    pipe, end = live()
    unexpected = {1: b"?" * 32}
    sealer = Sealer(
        secret=unexpected[1],
        epoch=1,
        context=KeyContext(Kind.DATA, PUBLISHER, 1, TOPIC),
        signer=MALLORY,
        random_bytes=urandom,
    )
    held = end.budget.held_bytes
    for number in range(1, 200):
        give(pipe, end, list(sealer.seal(number, Flag.RELIABLE, bytes(3_000), 1500)))
    assert end.budget.held_bytes == held
    assert end.writer_proxy.drops == {DropReason.BAD_TAG: 3 * 199}
    for at in range(50):
        pipe.tell(*Notes(reader_of(bytes([at])), pipe.source, TOPIC, unexpected).hello())
    assert pipe.publisher.readers == 1
    assert pipe.publisher.drops == {DropReason.BAD_TAG: 50, DropReason.UNKNOWN_SENDER: 50}
