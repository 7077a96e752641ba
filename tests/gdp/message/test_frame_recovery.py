"""Recovery of lost frames from parity, and what hostile parity cannot do."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gdp.crypto.parity_seal import ParityOpener, ParitySealer
from gdp.errors import DropReason, EnvelopeError
from gdp.frame.codec import HEADER_BYTES, Flag, Header, Kind, decode, encode
from gdp.limits import HOPS_MAX, RECOVERY_BYTES
from gdp.message import erasure
from gdp.message.frame_recovery import WAIT_MAX_S, FrameRecovery
from gdp.message.parity import SPAN_PARTS, Block, Parity, blocks_of, frame_of, shard_of, span_of
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.sansio import ReceivedFrame

SOURCE, TOPIC, SECRET = b"s" * 32, b"t" * 32, bytes(32)
SIZE = 102
FLAGS = int(Flag.PARITY)
VECTORS = json.loads((Path(__file__).parents[2] / "vectors" / "parity.json").read_text())


def frames_of(parts: int, number: int = 7, seed: int = 1, size: int = SIZE - 2) -> list[bytes]:
    """Return the frames of one message, of which the last is shorter."""
    rng, frames = random.Random(seed), []
    for part in range(parts):
        is_last = part == parts - 1
        payload = rng.randbytes(size // 2 if is_last else size)
        flags = FLAGS | (Flag.LAST if is_last else 0)
        head = Header(Kind.DATA, flags, HOPS_MAX, 1, len(payload), number, part, parts, 9, TOPIC, SOURCE)
        frames.append(encode(head) + payload)
    return frames


def parity_of(frames: list[bytes], count: int) -> list[tuple[Header, bytes]]:
    """Return headers and bodies of the parity of all blocks, in the order of sending."""
    parts, made = len(frames), []
    for first in range(0, parts, SPAN_PARTS):
        blocks = blocks_of(span_of(first, parts))
        size = max(map(len, frames)) - HEADER_BYTES + 2
        shards = [erasure.encode([shard_of(frames[part], size) for part in block.parts], count) for block in blocks]
        made += [
            Parity(block.first, index, count, of_block[index])
            for index in range(count)
            for block, of_block in zip(blocks, shards, strict=True)
        ]
    head = decode(frames[0])._replace(kind=int(Kind.PARITY))
    return [(head._replace(part=at), each.to_wire()) for at, each in enumerate(made)]


def recovery() -> tuple[FrameRecovery, ReassemblyQuota]:
    """Return a recovery, and its quota."""
    quota = ReassemblyQuota()
    return FrameRecovery(SOURCE, quota), quota


def feed(made: FrameRecovery, frames: list[bytes], lost: set[int], now_s: float = 0.0) -> None:
    """Give all frames but the lost ones."""
    for part, frame in enumerate(frames):
        if part not in lost:
            made.keep(decode(frame), frame, now_s)


def add(made: FrameRecovery, parity: list[tuple[Header, bytes]], now_s: float = 0.0) -> list[bytes]:
    """Give parity; return what it restores, which is kept as a reader does."""
    restored: list[bytes] = []
    for header, body in parity:
        try:
            new = made.add_parity(header, body, now_s)
        except EnvelopeError:
            continue
        for each in new:
            made.keep(decode(each), each, now_s)
        restored += new
    return restored


@settings(max_examples=60, deadline=None)
@given(parts=st.integers(3, 300), count=st.integers(1, 8), seed=st.integers(0, 1 << 32))
def test_what_each_block_may_lose_comes_back_to_the_bit(parts: int, count: int, seed: int) -> None:
    frames, (made, quota), rng = frames_of(parts), recovery(), random.Random(seed)
    lost: set[int] = set()
    for block in blocks_of(span_of(0, parts)):
        lost |= set(rng.sample(list(block.parts), min(rng.randint(0, count), block.size)))
    if len(lost) == parts:
        return
    feed(made, frames, lost)
    assert sorted(add(made, parity_of(frames, count))) == sorted(frames[part] for part in lost)
    made.close()
    assert quota.held_bytes == made.unfinished_bytes == 0


def test_a_burst_is_shared_out_among_interleaved_blocks() -> None:
    assert blocks_of(span_of(0, 738))[0] == Block(0, 6, 123)
    frames, (made, _) = frames_of(738), recovery()
    lost = set(range(100, 112))  # twelve in a row, of which two are in each block
    feed(made, frames, lost)
    assert len(add(made, parity_of(frames, 2))) == 12


def test_the_frames_of_a_complete_span_are_not_kept() -> None:
    frames, (made, quota) = frames_of(SPAN_PARTS + 5), recovery()
    feed(made, frames, {SPAN_PARTS})
    assert quota.held_bytes < 5 * 500
    assert add(made, parity_of(frames, 1)) == [frames[SPAN_PARTS]]


def test_frames_that_come_in_runs_are_kept_as_well() -> None:
    frames, (made, _) = frames_of(40), recovery()
    arrivals = [ReceivedFrame(0, b"", frame) for frame in frames]
    made.keep_run(arrivals, 0, 20, 0.0)
    made.keep_run(arrivals, 22, 18, 0.0)
    assert sorted(add(made, parity_of(frames, 2))) == sorted(frames[20:22])


def test_messages_without_the_flag_are_not_kept() -> None:
    made, quota = recovery()
    frame = frames_of(3)[0]
    made.keep(decode(frame)._replace(flags=0), frame, 0.0)
    assert quota.held_bytes == 0


def test_parity_of_an_unknown_or_complete_message_is_unused() -> None:
    frames, (made, _) = frames_of(10), recovery()
    parity = parity_of(frames, 2)
    for lost in (set(range(10)), set[int]()):
        feed(made, frames, lost)
        with pytest.raises(EnvelopeError) as raised:
            made.add_parity(*parity[0], 0.0)
        assert raised.value.reason is DropReason.UNUSED_PARITY


def test_a_replayed_parity_frame_counts_once() -> None:
    frames, (made, _) = frames_of(10), recovery()
    parity = parity_of(frames, 2)
    feed(made, frames, {1, 2})
    assert add(made, [parity[0]] * 5) == []
    assert sorted(add(made, parity[1:])) == sorted(frames[1:3])


@pytest.mark.parametrize(
    "body",
    [
        b"",
        bytes(8),
        Parity(0, 1, 1, bytes(SIZE)).to_wire(),
        Parity(0, 32, 40, bytes(SIZE)).to_wire(),
        Parity(1, 0, 1, bytes(SIZE)).to_wire(),
        Parity(1 << 31, 0, 1, bytes(SIZE)).to_wire(),
    ],
)
def test_parity_that_fits_no_block_is_malformed(body: bytes) -> None:
    frames, (made, _) = frames_of(10), recovery()
    feed(made, frames, {1})
    header = parity_of(frames, 1)[0][0]
    with pytest.raises(EnvelopeError) as raised:
        made.add_parity(header, body, 0.0)
    assert raised.value.reason is DropReason.MALFORMED
    assert add(made, parity_of(frames, 1)) == [frames[1]]


def test_parity_of_another_form_of_its_message_is_malformed() -> None:
    frames, (made, _) = frames_of(10), recovery()
    feed(made, frames, {1})
    (header, body), *_ = parity_of(frames, 1)
    with pytest.raises(EnvelopeError):
        made.add_parity(header._replace(parts=11), body, 0.0)


@pytest.mark.parametrize("size", [5, SIZE // 2, SIZE, SIZE + 50])
def test_forged_parity_never_blocks_repair(size: int) -> None:
    """A holder of the topic's secret sends random shards; the seals, which are not here, refuse what comes of it."""
    frames, (made, quota), rng = frames_of(10), recovery(), random.Random(size)
    feed(made, frames, {1})
    header = parity_of(frames, 1)[0][0]
    for index in range(2):
        try:
            restored = made.add_parity(
                header._replace(part=index), Parity(0, index, 2, rng.randbytes(size)).to_wire(), 0
            )
        except EnvelopeError as error:
            assert error.reason in (DropReason.MALFORMED, DropReason.UNUSED_PARITY)  # noqa: PT017
        else:
            assert frames[1] not in restored
    assert made.awaited_s(7, 0.001) == 0.0  # nothing more is awaited: the gap is requested
    made.close()
    assert quota.held_bytes == 0


def test_frames_and_parity_without_end_do_not_delay_a_request_for_long() -> None:
    frames, (made, _) = frames_of(900), recovery()
    asked_s = 0.01
    feed(made, frames[:3], {1})
    assert made.awaited_s(7, asked_s) > asked_s
    for at in range(3, 900):
        made.keep(decode(frames[at]), frames[at], at * 0.01)
    assert made.awaited_s(7, 0.01 + WAIT_MAX_S) == 0.0


def test_a_gap_is_not_requested_before_the_parity_has_passed() -> None:
    frames, (made, _) = frames_of(10), recovery()
    parity = parity_of(frames, 2)
    feed(made, frames, {1, 2})
    assert made.awaited_s(7, 0.001) == pytest.approx(0.02)
    add(made, parity[1:], now_s=0.01)  # the last one; the first one was lost
    assert made.awaited_s(7, 0.011) == 0.0


def test_a_gap_that_parity_cannot_fill_is_requested_with_the_first_parity_frame() -> None:
    frames, (made, _) = frames_of(10), recovery()
    feed(made, frames, {1, 2, 3})
    add(made, parity_of(frames, 2)[:1])
    assert made.awaited_s(7, 0.001) == 0.0


def test_memory_is_bounded_charged_and_released_in_time() -> None:
    made, quota = recovery()
    for number in range(16):
        for frame in frames_of(900, number, size=1_400)[:-1]:
            made.keep(decode(frame), frame, 0.0)
    assert 0 < quota.held_bytes == made.unfinished_bytes <= RECOVERY_BYTES
    made.give_way()
    made.drop_expired(0.5)
    assert quota.held_bytes
    assert made.next_expiry() == 1.0
    made.drop_expired(1.0)
    assert quota.held_bytes == 0


def test_a_quota_that_is_used_up_costs_the_recovery_and_nothing_else() -> None:
    quota = ReassemblyQuota(total_bytes=1_000, source_bytes=1_000)
    made = FrameRecovery(SOURCE, quota)
    frames = frames_of(20)
    feed(made, frames, {1})
    assert add(made, parity_of(frames, 2)) == []


def test_a_shard_whose_length_is_impossible_is_refused() -> None:
    header = decode(frames_of(3)[0])
    with pytest.raises(EnvelopeError):
        frame_of(header, 1, (200).to_bytes(2, "big") + bytes(100))
    with pytest.raises(EnvelopeError):
        shard_of(frames_of(3)[0], SIZE - 1)


def test_parity_frames_match_the_vectors() -> None:
    frames = [bytes.fromhex(each) for each in VECTORS["frames"]]
    names = {key: bytes.fromhex(VECTORS[key]) for key in ("secret", "source", "destination")}
    sealer = ParitySealer(epoch=1, incarnation=VECTORS["incarnation"], **names)
    opener = ParityOpener(names["secret"], names["source"], VECTORS["incarnation"], names["destination"])
    made, _ = recovery()
    feed(made, frames, set(VECTORS["lost"]))
    restored: list[bytes] = []
    for (header, body), expected in zip(parity_of(frames, 2), VECTORS["parity"], strict=True):
        frame = sealer.seal(header.number, header.part, header.parts, header.flags, body)
        assert (body.hex(), frame.hex()) == (expected["body"], expected["frame"])
        restored += made.add_parity(decode(frame), opener.open(decode(frame), frame), 0.0)
    assert sorted(restored) == sorted(frames[part] for part in VECTORS["lost"])


def test_a_stranger_and_an_altered_parity_frame_are_refused() -> None:
    frame = bytes.fromhex(VECTORS["parity"][0]["frame"])
    names = bytes.fromhex(VECTORS["source"]), VECTORS["incarnation"], bytes.fromhex(VECTORS["destination"])
    for secret, altered in ((b"x" * 32, frame), (bytes.fromhex(VECTORS["secret"]), frame[:-1] + b"\0")):
        with pytest.raises(EnvelopeError) as raised:
            ParityOpener(secret, *names).open(decode(altered), altered)
        assert raised.value.reason is DropReason.BAD_TAG
