"""Redundancy against loss: how often urgent frames are sent, when their copies leave, and how many bytes they take.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: docs/explanation/loss.md.

Each frame of an urgent message of one or two fragments is sent up to ``SENDS_MAX`` times, so that one of them arrives
without a repair. The copies are the same sealed bytes. They leave a few milliseconds apart, because radio loses
neighbouring frames together.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final

from gdp.frame.codec import INCARNATION_AT, PARTS_AT
from gdp.intervals import NEVER_S
from gdp.limits import SENDS_MAX
from gdp.message.second_copies import REPEATED_PARTS_MAX
from gdp.token_bucket import TokenBucket

_OFFSETS_S: Final = (0.004, 0.007)  # of the second and the third sending after the first
_SENDS: Final = ((0.001, 1), (0.025, 2))  # up to this loss, so many sendings leave at most 0.1 % undelivered
_UNKNOWN: Final = 2  # sendings before anything is measured
_LEAST_BYTES_S: Final = 8_000.0
_RATE_CHANGE: Final = 0.1
_PARTS: Final = slice(PARTS_AT, INCARNATION_AT)


class CopyBudget:
    """Bytes against loss that one participant may send, shared by its topics; of copies a twentieth of the path.

    Args:
        share: of the path.
        unknown_bytes_s: bytes a second while the rate of the path is not known: of copies a twentieth of 10 Mbit/s.
        burst_s: of this time, at once.
    """

    def __init__(self, share: float = 0.05, unknown_bytes_s: float = 64_000.0, burst_s: float = 0.25) -> None:
        self._share, self._unknown_bytes_s, self._burst_s = share, unknown_bytes_s, burst_s
        self._bytes_s = unknown_bytes_s
        self._bucket = TokenBucket(unknown_bytes_s, unknown_bytes_s * burst_s)

    def spend(self, now_s: float, size: int, path_bytes_s: float | None) -> bool:
        """Take ``size`` bytes and return True, or return False and take none."""
        bytes_s = self._unknown_bytes_s if path_bytes_s is None else max(path_bytes_s * self._share, _LEAST_BYTES_S)
        if abs(bytes_s - self._bytes_s) > _RATE_CHANGE * self._bytes_s:
            self._bytes_s = bytes_s
            self._bucket.change(now_s, bytes_s, bytes_s * self._burst_s)
        return self._bucket.spend(now_s, size)


def parity_budget() -> CopyBudget:
    """Return the budget of a participant's parity frames: 15 % of the path, and as much as a second gives at once.

    Of a path of unknown rate it is a tenth of 10 Mbit/s. A large message, which is what parity is for, has all of it at
    its end.
    """
    return CopyBudget(0.15, 125_000.0, burst_s=1.0)


def sends_for(loss: float | None) -> int:
    """Return how often an urgent frame is sent at a loss of frames (0 to 1; None: unknown)."""
    if loss is None:
        return _UNKNOWN
    return next((sends for highest, sends in _SENDS if loss <= highest), SENDS_MAX)


class Redundancy:
    """Copies of one publisher's urgent frames.

    Args:
        budget: of all publishers of the participant.
        is_enabled: the frames are urgent, and their rule allows copies.

    Attributes:
        is_enabled: as set.
        copies: frames that were sent again against loss.
        due_s: monotonic second at which a copy is due; infinity: none waits.
    """

    def __init__(self, *, budget: CopyBudget, is_enabled: bool) -> None:
        self._budget = budget
        self.is_enabled = is_enabled
        self._waiting = tuple(deque[tuple[float, bytes]]() for _ in _OFFSETS_S)
        self.copies = 0
        self.due_s = NEVER_S

    def handle_sent(
        self,
        frames: Sequence[bytes],
        loss: float | None,
        path_bytes_s: float | None,
        now_s: float,
        *,
        has_pair: bool = False,
    ) -> None:
        """Note DATA frames that leave now, and queue their copies.

        Args:
            loss: measured share of lost frames, 0 to 1; None: unknown.
            path_bytes_s: what the path carries; None: unknown.
            has_pair: each frame leaves over two paths.
        """
        sends = sends_for(loss)
        extra = (sends - 1) // 2 if has_pair else sends - 1
        for waiting, offset_s in zip(self._waiting[:extra], _OFFSETS_S, strict=False):
            for frame in frames:
                if int.from_bytes(frame[_PARTS], "big") > REPEATED_PARTS_MAX:
                    continue
                if not self._budget.spend(now_s, len(frame), path_bytes_s):
                    return
                waiting.append((now_s + offset_s, frame))
                self.due_s = min(self.due_s, waiting[0][0])

    def poll_copies(self, now_s: float) -> list[bytes]:
        """Remove and return the copies that are due."""
        due: list[bytes] = []
        for waiting in self._waiting:
            while waiting and waiting[0][0] <= now_s:
                due.append(waiting.popleft()[1])
        self.copies += len(due)
        self.due_s = min((waiting[0][0] for waiting in self._waiting if waiting), default=NEVER_S)
        return due

    def clear(self) -> None:
        """Drop the copies that wait: there is no reader any more."""
        for waiting in self._waiting:
            waiting.clear()
        self.due_s = NEVER_S
