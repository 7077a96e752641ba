"""AckNacks and Heartbeats on the wire."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gdp.errors import FrameError
from gdp.limits import NACKS_PER_REPORT
from gdp.message.acknack import AckNack, AckNackFlag, MissingRange
from gdp.message.heartbeat import PACES_MAX, STARTS_MAX, Heartbeat, StreamStart
from gdp.message.loss import GONE_MAX, LossReason, LostRange
from gdp.message.renumbering import MOVES_MAX, Renumbering
from gdp.message.striping import SHARE_WHOLE

U64 = st.integers(0, (1 << 64) - 1)
U32 = st.integers(0, (1 << 32) - 1)
MISSING = st.lists(st.builds(MissingRange, U64, U32, U32), max_size=NACKS_PER_REPORT).map(tuple)
FLAGS = st.sampled_from([*AckNackFlag, AckNackFlag.NONE])
REPORTS = st.builds(
    AckNack, FLAGS, U64, U32, MISSING, U64, U64, st.integers(0, SHARE_WHOLE), U32, U64, U32, U32, U32, U64
)
MOVES = st.lists(
    st.builds(lambda first, span, gap: Renumbering(first, span, first + span + gap), *[st.integers(1, 1 << 60)] * 3),
    max_size=MOVES_MAX,
).map(tuple)
STARTS = st.dictionaries(
    st.binary(min_size=32, max_size=32), st.builds(StreamStart, U64, U64, U64, U64), max_size=STARTS_MAX
)
LOST = st.builds(lambda a, b, reason: LostRange(min(a, b), max(a, b), reason), U64, U64, st.sampled_from(LossReason))
GONE = st.lists(LOST, max_size=GONE_MAX).map(tuple)
PACES = st.dictionaries(st.binary(min_size=32, max_size=32), st.integers(0, 255), max_size=PACES_MAX)


@given(REPORTS)
def test_a_report_comes_back_as_it_was(acknack: AckNack) -> None:
    assert AckNack.from_wire(acknack.to_wire()) == acknack


@given(U64, U64, STARTS, st.binary(max_size=100), MOVES, GONE, PACES)
def test_a_status_comes_back_as_it_was(
    one: int,
    other: int,
    starts: dict[bytes, StreamStart],
    description: bytes,
    moves: tuple[Renumbering, ...],
    gone: tuple[LostRange, ...],
    paces: dict[bytes, int],
) -> None:
    ends = min(one, other), max(one, other), one % (1 << 32)
    status = Heartbeat(*ends, starts, description, moves, one, other, gone, tuple(paces.items()))
    assert Heartbeat.from_wire(status.to_wire()) == status


def test_a_move_that_leads_back_is_malformed() -> None:
    with pytest.raises(FrameError):
        Heartbeat.from_wire(Heartbeat(5, 5, 0, {}, b"", (Renumbering(3, 2, 5),)).to_wire())


@given(st.binary(max_size=200))
@example(b"")
@example(bytes(29) + b"\xff\xff")
def test_arbitrary_bytes_are_a_report_or_a_frame_error(wire: bytes) -> None:
    try:
        acknack = AckNack.from_wire(wire)
    except FrameError:
        return
    assert acknack.to_wire() == wire


@given(st.binary(max_size=200))
@example(bytes(36) + b"\xff\xff")
def test_arbitrary_bytes_are_a_status_or_a_frame_error(wire: bytes) -> None:
    try:
        status = Heartbeat.from_wire(wire)
    except FrameError:
        return
    assert status.oldest <= status.sent_number
    assert len(status.starts) <= STARTS_MAX


def test_ranges_beyond_the_limit_wait_for_the_next_report() -> None:
    ranges = tuple(MissingRange(number, 0, 1) for number in range(NACKS_PER_REPORT + 10))
    assert AckNack.from_wire(AckNack(AckNackFlag.NONE, 0, 0, ranges).to_wire()).missing == ranges[:NACKS_PER_REPORT]
