"""Opener of captures: what topic secrets open, and what is said of the other frames."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import count

import cbor2
import pytest

from gdp.client.unicast_stream import PeerIncarnation, private_incarnation, private_name
from gdp.crypto.control_seal import ControlContext, ControlSealer, control_key
from gdp.crypto.envelope import KeyContext, Sealer, seal_key
from gdp.crypto.keys import SigningKey
from gdp.crypto.parity_seal import ParitySealer
from gdp.frame.codec import HEADER_BYTES, Flag, Kind, decode, encode
from gdp.message import erasure
from gdp.message.bundle import pack
from gdp.message.heartbeat import Heartbeat
from gdp.message.parity import Parity, blocks_of, shard_of, span_of
from gdp.names import Name
from gdp.trust.grants import topic_secret
from gdp_extensions.dissector.capture_opener import CaptureKeys, CaptureOpener, OpenedMessage, Outcome

TOPIC, OTHER = Name(b"t" * 32), Name(b"o" * 32)
WRITER, READER = PeerIncarnation(Name(b"w" * 32), 7), PeerIncarnation(Name(b"r" * 32), 9)
SECRET = b"k" * 32
KEY = SigningKey.generate()
EPOCH = 3
KEYS = CaptureKeys({TOPIC: {EPOCH: SECRET}})


def sealer(
    kind: Kind = Kind.DATA,
    topic: Name = TOPIC,
    secret: bytes = SECRET,
    epoch: int = EPOCH,
    address: bytes | None = None,
    incarnation: int = WRITER.incarnation,
) -> Sealer:
    return Sealer(
        secret=secret,
        epoch=epoch,
        context=KeyContext(kind, WRITER.name, incarnation, topic),
        signer=KEY,
        random_bytes=random.Random(1).randbytes,
        address=address,
    )


def note(kind: Kind, key: bytes, sender: PeerIncarnation = READER, to: PeerIncarnation = WRITER) -> bytes:
    made = ControlSealer(
        key=key,
        epoch=EPOCH,
        context=ControlContext(kind, sender.name, sender.incarnation, to.name, to.incarnation, TOPIC),
        numbers=count(1),
    )
    return made.seal(b"body")


def run(keys: CaptureKeys, frames: Iterable[bytes]) -> tuple[list[OpenedMessage], dict[Name, Counter[Outcome]]]:
    opener, frames = CaptureOpener(keys), list(frames)
    for frame in frames:
        opener.observe(frame)
    opened = [each for frame in frames for each in opener.handle(frame, 0.0)]
    opener.count_unfinished()
    assert sum(counts.total() for counts in opener.outcomes.values()) == len(frames)
    return opened, {name: +counts for name, counts in opener.outcomes.items()}


def message(sequence: int, body: bytes) -> bytes:
    return sequence.to_bytes(8, "big") + body


def test_a_message_of_many_parts_in_any_order_is_opened_once_and_repeated_frames_are_distinguished() -> None:
    body = random.Random(2).randbytes(5_000)
    frames = list(sealer().seal(1, Flag.RELIABLE, message(4, body), 1_000))
    random.Random(3).shuffle(frames)
    opened, outcomes = run(KEYS, [*frames, *frames[:2]])
    assert [(each.topic, each.sequence, each.body, each.restored) for each in opened] == [(TOPIC, 4, body, 0)]
    assert outcomes == {TOPIC: Counter({Outcome.OPENED: len(frames), Outcome.REPEATED: 2})}


def test_each_message_of_a_bundle_has_its_own_sequence_number() -> None:
    (frame,) = sealer().seal(1, Flag.BUNDLE, message(11, pack([b"a", b"", b"ccc"])), 1_500)
    opened, _ = run(KEYS, [frame])
    assert [(each.sequence, each.body) for each in opened] == [(11, b"a"), (12, b""), (13, b"ccc")]


def test_the_description_of_a_heartbeat_says_the_encoding_of_later_messages() -> None:
    description = cbor2.dumps({"c": [], "e": "cbor"})
    heartbeat = Heartbeat(1, 1, 0, {}, description).to_wire()
    frames = [*sealer(Kind.HEARTBEAT).seal(1, 0, heartbeat, 1_500), *sealer().seal(1, 0, message(1, b"x"), 1_500)]
    opened, _ = run(KEYS, frames)
    assert [(each.header.kind, each.encoding) for each in opened] == [(Kind.HEARTBEAT, ""), (Kind.DATA, "cbor")]


def with_parity(body: bytes, parity: int) -> tuple[list[bytes], list[bytes]]:
    frames = list(sealer().seal(1, Flag.PARITY, message(1, body), 600))
    parts, size = len(frames), max(map(len, frames)) - HEADER_BYTES + 2
    made = ParitySealer(
        secret=SECRET, epoch=EPOCH, source=WRITER.name, incarnation=WRITER.incarnation, destination=TOPIC
    )
    bodies = [
        Parity(block.first, index, parity, shard).to_wire()
        for block in blocks_of(span_of(0, parts))
        for index, shard in enumerate(erasure.encode([shard_of(frames[part], size) for part in block.parts], parity))
    ]
    return frames, [made.seal(1, at, parts, Flag.PARITY, each) for at, each in enumerate(bodies)]


def test_parts_that_were_not_captured_are_restored_from_parity() -> None:
    pytest.importorskip("numpy")
    body = random.Random(4).randbytes(6_000)
    frames, parity = with_parity(body, 2)
    opened, outcomes = run(KEYS, [*frames[:3], *frames[4:-1], *parity])
    whole = [each for each in opened if each.header.kind == Kind.DATA]
    assert [(each.body, each.restored) for each in whole] == [(body, 2)]
    assert [each.body[5] for each in opened if each.header.kind == Kind.PARITY] == [2, 2]
    assert outcomes == {TOPIC: Counter({Outcome.OPENED: len(frames) - 2 + len(parity)})}


def test_frames_of_a_message_that_was_not_captured_whole_are_counted_as_incomplete() -> None:
    pytest.importorskip("numpy")
    frames, parity = with_parity(bytes(6_000), 1)
    opened, outcomes = run(KEYS, [*frames[:2], *frames[4:], *parity])
    assert [each.header.kind for each in opened] == [Kind.PARITY]
    assert outcomes == {TOPIC: Counter({Outcome.INCOMPLETE: len(frames) - 2, Outcome.OPENED: 1})}


def introduction() -> bytes:
    return note(Kind.INTRODUCTION, seal_key(SECRET, Kind.INTRODUCTION, *READER, WRITER.name))


def test_an_introduction_opens_where_the_capture_shows_its_publishers_incarnation() -> None:
    (data,) = sealer().seal(1, 0, message(1, b"x"), 1_500)
    opened, outcomes = run(KEYS, [introduction(), data])
    assert [(each.header.kind, each.body) for each in opened] == [(Kind.INTRODUCTION, b"body"), (Kind.DATA, b"x")]
    assert outcomes == {TOPIC: Counter({Outcome.OPENED: 2})}
    assert run(KEYS, [introduction()])[1] == {TOPIC: Counter({Outcome.NO_INCARNATION: 1})}


def test_an_acknack_stays_shut_and_the_reason_is_named() -> None:
    shared = b"s" * 32
    key = control_key(shared, SECRET, Kind.ACKNACK, *READER, *WRITER, TOPIC)
    assert run(KEYS, [note(Kind.ACKNACK, key)]) == ([], {TOPIC: Counter({Outcome.ACK_NACK: 1})})


def private(*, is_session: bool) -> Iterator[bytes]:
    """Yield frames that show the incarnations of both ends, and one of the private stream from one to the other."""
    yield from sealer().seal(1, 0, message(1, b"to all"), 1_500)
    yield introduction()
    stream = private_name(TOPIC, WRITER, READER, is_session=is_session)
    made = sealer(topic=stream, address=READER.name, incarnation=private_incarnation(stream))
    yield from made.seal(1, Flag.RELIABLE, message(1, b"to one"), 1_500)


def test_a_private_answer_opens_with_the_secret_of_its_service() -> None:
    opened, outcomes = run(KEYS, private(is_session=False))
    assert [each.body for each in opened] == [b"to all", b"body", b"to one"]
    assert {each.topic for each in opened} == {TOPIC}
    assert outcomes == {TOPIC: Counter({Outcome.OPENED: 3})}


def test_a_private_answer_under_a_session_secret_stays_shut_and_the_reason_is_named() -> None:
    _, outcomes = run(KEYS, private(is_session=True))
    assert outcomes[READER.name] == Counter({Outcome.SESSION: 1})


def test_frames_of_other_names_other_epochs_and_other_keys_are_counted_by_reason() -> None:
    frames = [
        *sealer(topic=OTHER).seal(1, 0, message(1, b"x"), 1_500),
        *sealer(epoch=EPOCH + 1).seal(2, 0, message(1, b"x"), 1_500),
        *sealer(secret=b"z" * 32).seal(3, 0, message(1, b"x"), 1_500),
        encode(decode(introduction())._replace(kind=Kind.HELLO, length=0)),
        b"short",
    ]
    opened, outcomes = run(KEYS, frames)
    assert opened == []
    assert outcomes == {
        OTHER: Counter({Outcome.NO_KEY: 1}),
        TOPIC: Counter({Outcome.NO_EPOCH: 1, Outcome.BAD_TAG: 1}),
        WRITER.name: Counter({Outcome.NOT_SEALED: 1}),
        Name(bytes(32)): Counter({Outcome.MALFORMED: 1}),
    }


def test_an_owner_opens_every_epoch_of_its_names_and_no_name_of_another() -> None:
    master = b"m" * 32
    frames = [
        *sealer(secret=topic_secret(master, TOPIC, 9), epoch=9).seal(1, 0, message(1, b"mine"), 1_500),
        *sealer(topic=OTHER).seal(1, 0, message(1, b"x"), 1_500),
    ]
    opened, outcomes = run(CaptureKeys(masters=(master,)), frames)
    assert [each.body for each in opened] == [b"mine"]
    assert outcomes == {TOPIC: Counter({Outcome.OPENED: 1}), OTHER: Counter({Outcome.NO_KEY: 1})}


def test_keys_do_not_show_in_a_traceback() -> None:
    assert "6b6b" not in repr(KEYS)
    assert repr(SECRET)[2:10] not in repr(KEYS)
