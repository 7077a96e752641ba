"""Receipts: by samples, a reader proves how many frames came.

Sans-I/O. A reader's counts decide how fast its writer sends, so invented ones would flood the path (RFC 9000, section
21.4). One frame in 64 is a sample, by the last byte of its seal. A report carries the sum of the seals of the samples
that came; the writer finds the set of samples that has this sum. Seals depend on the salt of their message. The seal of
a frame that did not come is known only where another frame of its message came and the content can be guessed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from math import sqrt
from typing import Final

RECEIPTS_MASK: Final = (1 << 64) - 1  # of a sum
_DUE_MAX: Final = 16  # samples of one report; of more nothing is concluded, because the sums of all sets are tried
_SPARE_MAX: Final = 8  # samples that may come in addition: late ones, and repairs
_MEMORY: Final = 64.0  # samples that count
_DOUBT: Final = 3.0  # standard deviations that chance explains


class ReceiptCheck:
    """Check of the counts of one reader; the place of a frame is the count of frames sent up to it."""

    def __init__(self) -> None:
        self._due = deque[tuple[int, int]]()
        self._spare = deque[int](maxlen=_SPARE_MAX)
        self._total = 0
        self._sent = self._stated = self._came = 0.0  # samples; those that came by the counts, and by the receipts
        self._lost = 0.0  # share of the frames that are proven to be lost

    def sent(self, samples: Sequence[tuple[int, int]], place: int, *, is_repair: bool) -> None:
        """Note the samples among frames that leave, the first of which has ``place``."""
        if is_repair:
            self._spare.extend(seal for _, seal in samples)
        else:
            self._due.extend((place + each, seal) for each, seal in samples)

    def begin(self, total: int, place: int) -> None:
        """Take the sum in a reader's first report, whose newest frame has this place."""
        self._take(place)
        self._total = total

    def judge(self, total: int, place: int, frames: int, lost: int) -> int:
        """Return how many frames to count as lost: what the reader counts, or more if its receipts show less.

        Args:
            total: sum in the report.
            place: of its newest frame.
            frames: that it confirms.
            lost: of them, as the reader counts.
        """
        due, gain, self._total = self._take(place), total - self._total & RECEIPTS_MASK, total
        if due or self._spare:
            if len(due) > _DUE_MAX:
                return lost
            self._count(due, gain, max(1 - lost / frames, 0.0))
        return max(lost, round(frames * self._lost)) if self._lost else lost

    def _count(self, due: list[int], gain: int, stated: float) -> None:
        """Count the samples that were due: those that came by the counts, and those that the sum proves."""
        seals, count = [*due, *self._spare], len(due)
        came = _set_of_sum(seals, gain)
        self._spare = deque((each for at, each in enumerate(seals) if not came >> at & 1), maxlen=_SPARE_MAX)
        kept = min(_MEMORY / (self._sent + count or 1.0), 1.0)
        self._sent = (self._sent + count) * kept
        self._stated = (self._stated + count * stated) * kept
        self._came = (self._came + (came & (1 << count) - 1).bit_count()) * kept
        is_doubted = self._stated - self._came > _DOUBT * sqrt(self._sent)
        self._lost = 1 - self._came / self._sent if is_doubted else 0.0

    def _take(self, place: int) -> list[int]:
        """Remove and return the samples up to a place."""
        taken = list[int]()
        while self._due and self._due[0][0] <= place:
            taken.append(self._due.popleft()[1])
        return taken


def _set_of_sum(seals: Sequence[int], total: int) -> int:
    """Return which seals have this sum, as bits; 0 if no set of them has."""
    half = len(seals) // 2
    lower = {each: bits for bits, each in enumerate(_sums(seals[:half]))}
    for bits, each in enumerate(_sums(seals[half:])):
        if total - each & RECEIPTS_MASK in lower:
            return bits << half | lower[total - each & RECEIPTS_MASK]
    return 0


def _sums(seals: Iterable[int]) -> list[int]:
    """Return the sums of all sets of seals, in the order of their bits."""
    sums = [0]
    for seal in seals:
        sums += [each + seal & RECEIPTS_MASK for each in sums]
    return sums
