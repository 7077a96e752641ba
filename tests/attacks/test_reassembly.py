"""Attacks on the memory of unfinished messages."""

from __future__ import annotations

from os import urandom

from gdp.crypto.envelope import KeyContext, Opener, Sealer, Signer
from gdp.frame.codec import Kind, decode
from gdp.limits import JOIN_SOURCE_BYTES, JOIN_TOTAL_BYTES, MESSAGE_MAX_BYTES
from gdp.message.reassembly import ReassembledMessage, Reassembler
from gdp.message.reassembly_quota import ReassemblyQuota
from tests.gdp.message.sealed import INCARNATION, OTHER, SECRET, WRITER

TOTAL_BYTES = 96 << 10
SOURCE_BYTES = 48 << 10
IMAGE = bytes(16 << 10)
MTU = 1_500


class Stream:
    """One topic of one publisher, at a reader that has the topic's secret."""

    def __init__(self, budget: ReassemblyQuota, source: bytes, topic: bytes = b"t" * 32) -> None:
        self.source = source
        self.topic = topic
        self.reassembler = Reassembler(
            source, lambda _: Opener(SECRET, Kind.DATA, source, INCARNATION, topic), WRITER.public, budget
        )

    def frames(self, number: int, message: bytes, signer: Signer = WRITER) -> list[bytes]:
        sealer = Sealer(
            secret=SECRET,
            epoch=1,
            context=KeyContext(Kind.DATA, self.source, INCARNATION, self.topic),
            signer=signer,
            random_bytes=urandom,
        )
        return list(sealer.seal(number, 0, message, MTU))

    def give(self, frames: list[bytes]) -> list[ReassembledMessage]:
        got = [self.reassembler.add(decode(frame), frame, 0.0) for frame in frames]
        return [joined for joined in got if joined is not None]

    def forge(self, numbers: range = range(10, 14)) -> None:
        """Insert fragments of another reader: they open, but no message of them is ever complete."""
        for number in numbers:
            self.give(self.frames(number, bytes(12 << 10), OTHER)[:-1])


def test_a58_forged_parts_in_two_publishers_names_leave_a_third_its_fair_part() -> None:
    budget = ReassemblyQuota(TOTAL_BYTES, SOURCE_BYTES)
    forged = [Stream(budget, name * 32) for name in (b"a", b"b")]
    for stream in forged:
        stream.forge(range(10, 20))
    assert budget.held_bytes > 0.8 * TOTAL_BYTES
    third = Stream(budget, b"c" * 32)
    assert [joined.message for joined in third.give(third.frames(1, IMAGE))] == [IMAGE]
    assert budget.held_bytes <= TOTAL_BYTES


def test_a58_parts_that_keep_coming_do_not_push_out_who_holds_less() -> None:
    budget = ReassemblyQuota(TOTAL_BYTES, SOURCE_BYTES)
    forged = [Stream(budget, name * 32) for name in (b"a", b"b")]
    third = Stream(budget, b"c" * 32)
    got: list[ReassembledMessage] = []
    for at, frame in enumerate(third.frames(1, IMAGE)):
        forged[at % 2].forge(range(10 + 4 * at, 14 + 4 * at))
        got += third.give([frame])
    assert [joined.message for joined in got] == [IMAGE]


def test_a58_parts_forged_in_one_topic_leave_the_publishers_other_topics_alone() -> None:
    budget = ReassemblyQuota(TOTAL_BYTES, SOURCE_BYTES)
    other = Stream(budget, b"a" * 32, b"u" * 32)
    forged = Stream(budget, b"a" * 32)
    forged.forge(range(10, 20))
    assert [joined.message for joined in other.give(other.frames(1, IMAGE))] == [IMAGE]


def test_a58_no_source_holds_more_than_its_bound_or_the_whole_quota() -> None:
    budget = ReassemblyQuota(TOTAL_BYTES, SOURCE_BYTES)
    streams = [Stream(budget, bytes([name]) * 32) for name in range(5)]
    for stream in streams:
        stream.forge(range(10, 20))
        assert stream.reassembler.unfinished_bytes <= SOURCE_BYTES
        assert budget.held_bytes <= TOTAL_BYTES
    held = [stream.reassembler.unfinished_bytes for stream in streams]
    assert min(held) > TOTAL_BYTES // 16
    assert sum(held) == budget.held_bytes
    for stream in streams:
        stream.reassembler.close()
    assert budget.held_bytes == 0


def test_a58_the_largest_message_of_a_lone_source_fits_and_so_do_three() -> None:
    assert MESSAGE_MAX_BYTES * 1.3 < JOIN_TOTAL_BYTES / 3 <= JOIN_SOURCE_BYTES
    stream = Stream(ReassemblyQuota(), b"a" * 32)
    message = bytes(MESSAGE_MAX_BYTES)
    sealer = Sealer(
        secret=SECRET,
        epoch=1,
        context=KeyContext(Kind.DATA, stream.source, INCARNATION, stream.topic),
        signer=WRITER,
        random_bytes=urandom,
    )
    (joined,) = stream.give(list(sealer.seal(1, 0, message, 9_000)))
    assert len(joined.message) == MESSAGE_MAX_BYTES
