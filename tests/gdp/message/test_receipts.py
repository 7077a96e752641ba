"""Receipts: what a reader counts is believed as far as its samples show it."""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.burst import samples
from gdp.message.receipts import ReceiptCheck

FLIGHT = 40


@dataclass
class Reader:
    """A reader behind a path that loses, delays and repairs, and the check of its writer."""

    seed: int
    check: ReceiptCheck = field(default_factory=ReceiptCheck)
    total: int = 0
    sent: int = 0

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)
        self.late = deque[bytes]()
        self.check.begin(0, 0)

    def flight(self, loss: float, lateness: float = 0.0, repaired: float = 0.0) -> tuple[int, int]:
        """Send frames; return how many of them, and how many were lost."""
        frames = [self.random.randbytes(40) for _ in range(FLIGHT)]
        self.check.sent(samples(frames, 0, FLIGHT), self.sent + 1, is_repair=False)
        self.sent += len(frames)
        came, lost = [*self.late], list[bytes]()
        self.late.clear()
        for frame in frames:
            if self.random.random() >= loss:
                (self.late if self.random.random() < lateness else came).append(frame)
            else:
                lost.append(frame)
        again = [frame for frame in lost if self.random.random() < repaired]
        self.check.sent(samples(again, 0, len(again)), 0, is_repair=True)
        self.total += sum(seal for _, seal in samples([*came, *again], 0, 2 * FLIGHT))
        return len(frames), len(lost) + len(self.late)

    def judged(self, frames: int, lost: int) -> int:
        """Return how many of the frames count as lost after a report."""
        return self.check.judge(self.total & (1 << 64) - 1, self.sent, frames, lost)


@given(st.integers(), st.floats(0, 1), st.sampled_from([0.0, 0.02]), st.floats(0, 1))
def test_a_reader_that_tells_the_truth_is_believed(seed: int, loss: float, lateness: float, repaired: float) -> None:
    reader = Reader(seed)
    for _ in range(100):
        frames, lost = reader.flight(loss, lateness, repaired)
        assert reader.judged(frames, lost) == lost


@pytest.mark.parametrize("loss", [0.6, 0.9, 1.0])
def test_frames_that_a_reader_only_says_to_have_count_as_lost(loss: float) -> None:
    reader = Reader(1)
    judged = [reader.judged(reader.flight(loss)[0], 0) for _ in range(200)]
    assert sum(judged[100:]) >= 0.9 * loss * 100 * FLIGHT


def test_an_invented_sum_proves_nothing() -> None:
    reader = Reader(2)
    for _ in range(100):
        frames, _ = reader.flight(0.0)
        reader.total = reader.random.getrandbits(64)
        judged = reader.judged(frames, 0)
    assert judged >= 0.9 * FLIGHT


def test_a_reader_that_tells_the_truth_again_is_believed_again() -> None:
    reader = Reader(3)
    for _ in range(100):
        reader.judged(reader.flight(0.9)[0], 0)
    for _ in range(200):
        frames, lost = reader.flight(0.1)
        judged = reader.judged(frames, lost)
    assert judged == lost
