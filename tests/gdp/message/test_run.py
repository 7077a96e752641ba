"""Fast path of fragments in order; its result must equal that of the general path."""

from __future__ import annotations

from random import Random

from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import DropReason, FrameError
from gdp.frame.codec import HEADER_BYTES, HOPS_AT, decode
from gdp.message.reassembly import ReassembledMessage, Reassembler
from gdp.message.reassembly_quota import ReassemblyQuota
from gdp.sansio import ReceivedFrame
from tests.gdp.message.sealed import add_all, reassembler, seal

LONG = bytes(range(256)) * 64


def take(to: Reassembler, frames: list[bytes], at_once: int = 64) -> tuple[list[ReassembledMessage], int]:
    """Give frames in batches, on the fast path where possible; return the messages and the count of fast ones."""
    joined: list[ReassembledMessage] = []
    short = 0
    for begin in range(0, len(frames), at_once):
        arrivals = [ReceivedFrame(0, bytes(6), frame) for frame in frames[begin : begin + at_once]]
        at = 0
        while at < len(arrivals):
            taken = to.add_batch(arrivals, at, 0.0)
            short += taken
            at += taken
            if not taken:
                frame = arrivals[at].frame
                whole = to.add(decode(frame), frame, 0.0)
                joined += [whole] if whole is not None else []
                at += 1
    return joined, short


def test_all_inner_parts_but_the_first_go_the_short_way() -> None:
    frames = seal(1, LONG)
    joined, short = take(reassembler(), frames)
    assert [each.message for each in joined] == [LONG]
    assert short >= len(frames) - 3


@given(st.integers(0, 1 << 32), st.integers(1, 40), st.floats(0, 0.2), st.floats(0, 0.2))
def test_both_ways_join_the_same(seed: int, at_once: int, doubled: float, swapped: float) -> None:
    random = Random(seed)
    sizes = [random.randrange(0, 9_000) for _ in range(3)]
    frames = [frame for number, size in enumerate(sizes, 1) for frame in seal(number, random.randbytes(size))]
    frames = [frame for each in frames for frame in [each] * (1 + (random.random() < doubled))]
    for at in range(1, len(frames)):
        if random.random() < swapped:
            frames[at - 1], frames[at] = frames[at], frames[at - 1]
    budget = ReassemblyQuota()
    by_both, _ = take(reassembler(budget), frames, at_once)
    by_one = add_all(reassembler(), frames)
    assert by_both == by_one
    assert [len(each.message) for each in sorted(by_both, key=lambda each: each.number)] == sizes
    assert budget.held_bytes == 0


@given(st.integers(1, 60), st.integers(0, HEADER_BYTES + 150), st.integers(0, 7))
def test_an_altered_part_dies_alone(part: int, at: int, bit: int) -> None:
    frames = seal(1, LONG)
    bad = bytearray(frames[part])
    bad[at] ^= 1 << bit
    to = reassembler()
    try:
        decode(bytes(bad))
    except FrameError:  # never reaches the Reassembler
        return
    joined, _ = take(to, [*frames[:part], bytes(bad), *frames[part:]])
    assert [each.message for each in joined] == [LONG]
    if at != HOPS_AT:
        assert sum(to.drops.values()) == 1


def test_memory_is_charged_before_a_run_is_opened() -> None:
    budget = ReassemblyQuota(total_bytes=12_000, source_bytes=12_000)
    to = reassembler(budget)
    joined, _ = take(to, seal(1, LONG))
    assert joined == []
    assert to.drops[DropReason.MEMORY_FULL] > 0
    assert budget.held_bytes <= 12_000


@given(st.integers(0, 1 << 32), st.integers(1, 70), st.floats(0, 0.3))
def test_parts_behind_gaps_go_the_short_way_to_the_same_state(seed: int, at_once: int, loss: float) -> None:
    random, frames, ends = Random(seed), seal(1, LONG), (reassembler(), reassembler())
    lost = [frame for frame in frames if random.random() < loss]
    came = [frame for frame in frames if frame not in lost]
    joined, short = take(ends[0], came, at_once)
    assert add_all(ends[1], came) == joined
    assert short >= len(came) - len(lost) - 2 - len(frames) // at_once - 2
    states = [
        (to.missing(1, 99, to_end=True), to.extent(1), to.progress(1), to.new_parts, to.full_parts) for to in ends
    ]
    assert states[0] == states[1]
    assert ends[0].drops == ends[1].drops
    for to in ends if lost else ():
        assert [each.message for each in add_all(to, lost)] == [LONG]
        assert to.unfinished_bytes == 0
