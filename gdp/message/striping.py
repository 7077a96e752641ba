"""Striping of large messages over two paths: which fragment takes which path, by what the reader sees of them.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: docs/explanation/two-paths.md.

The reader compares when the last fragment of a message came by either path. Paths that end at the same time carry what
they can, so the share of the one that ends later falls. No capacity has to be known. The first fragment of each message
takes both paths, so a path with a share of 0 is still measured. Short messages and repairs take both paths, too.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Container, Sequence
from dataclasses import dataclass
from typing import Final

from gdp.frame.codec import INCARNATION_AT, PACE_AT, PART_AT, PARTS_AT, second_path_copy
from gdp.limits import PATH_LAG_MAX_S, STRIPES_FROM_PARTS

SHARE_WHOLE: Final = 255
_START: Final = 0.5
_KEPT: Final = 64  # messages under way whose paths are compared
_STEP: Final = 0.25  # of the share, for a path that is idle during the whole message
_NEWS: Final = 0.02
_SHORT_S: Final = 0.002  # a message that came faster shows nothing of its paths
_LAG_SPREAD: Final = 1.25
_DECAY: Final = 0.9


@dataclass(slots=True)
class _Arrival:
    """When fragments of one message came by either path; ``last_s`` of a path that brought none is None."""

    begin_s: float
    last_s: list[float | None]


class StripedPaths:
    """What a reader sees of the paths of one writer's striped messages.

    Attributes:
        share: of the fragments that the second path is to carry, 0 to 1.
    """

    __slots__ = ("_came", "_lag_s", "_reported", "share")

    def __init__(self) -> None:
        self.share = self._reported = _START
        self._lag_s = 0.0
        self._came: OrderedDict[int, _Arrival] = OrderedDict()

    def handle_arrivals(self, number: int, first: int, second: int, now_s: float) -> None:
        """Note authentic or copied fragments of a long message: how many came by the first path, and by the second."""
        arrival = self._came.get(number)
        if arrival is None:
            arrival = self._came[number] = _Arrival(now_s, [None, None])
            if len(self._came) > _KEPT:
                self._came.popitem(last=False)
        if first:
            arrival.last_s[0] = now_s
        if second:
            arrival.last_s[1] = now_s

    def handle_complete(self, number: int) -> None:
        """Compare the paths of a message that is complete."""
        arrival = self._came.pop(number, None)
        if arrival is None:
            return
        one_s, two_s = arrival.last_s
        if one_s is None or two_s is None:
            self.share = 0.0 if two_s is None else 1.0  # a path that brings nothing is broken
            return
        took_s = max(one_s, two_s) - arrival.begin_s
        self._lag_s = max(min(abs(one_s - two_s), PATH_LAG_MAX_S), self._lag_s * _DECAY)
        if took_s > _SHORT_S:
            self.share = min(max(self.share + _STEP * (one_s - two_s) / took_s, 0.0), 1.0)

    @property
    def has_news(self) -> bool:
        """Return whether the writer knows another share by now."""
        return abs(self.share - self._reported) > _NEWS

    def poll_share(self) -> int:
        """Return the share for a report, 0 to ``SHARE_WHOLE``."""
        self._reported = self.share
        return round(self.share * SHARE_WHOLE)

    def lag_s(self) -> float:
        """Return how long a fragment of the slower path may come after those of the faster one."""
        return _LAG_SPREAD * self._lag_s

    def handle_first(self, number: int, part: int, now_s: float) -> None:
        """Ignore that a fragment came: ``handle_arrivals`` knows its path."""

    def handle_copy(self, number: int, part: int, now_s: float) -> None:
        """Ignore that a copy came: ``handle_arrivals`` knows its path."""


class Striper:
    """Choice of the path of each frame of one writer."""

    __slots__ = ("_owed", "_shares")

    def __init__(self) -> None:
        self._shares: dict[bytes, float] = {}
        self._owed = 0.0  # of a fragment for the second path

    def handle_share(self, reader: bytes, share: int) -> None:
        """Note the share that a reader wants for the second path, 0 to ``SHARE_WHOLE``."""
        self._shares[reader] = share / SHARE_WHOLE

    def share(self, readers: Container[bytes]) -> float:
        """Return the mean share of present readers; the others are forgotten."""
        for reader in [each for each in self._shares if each not in readers]:
            del self._shares[reader]
        return sum(self._shares.values()) / len(self._shares) if self._shares else _START

    def stripe(self, frames: Sequence[bytes], doubled: int, readers: Container[bytes]) -> list[bytes]:
        """Return the frames as they leave; the first ``doubled`` are repairs or Heartbeats, and take both paths."""
        share = self.share(readers)
        out: list[bytes] = []
        for at, frame in enumerate(frames):
            if at < doubled or not _is_striped(frame):
                out += (frame, second_path_copy(frame))
                continue
            self._owed += share
            if self._owed >= 1.0:
                self._owed -= 1.0
                frame = second_path_copy(frame)  # noqa: PLW2901
            out.append(frame)
        return out


def _is_striped(frame: bytes) -> bool:
    """Return whether a frame takes one path alone."""
    parts = int.from_bytes(frame[PARTS_AT:INCARNATION_AT], "big")
    return parts >= STRIPES_FROM_PARTS and frame[PART_AT:PACE_AT] != b"\0\0\0\0"
