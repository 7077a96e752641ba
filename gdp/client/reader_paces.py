"""Paces of the readers of a best-effort topic: those behind thin links get whole messages as their links carry them.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A reader that holds back the others is given a pace, a class
of its path's rate. It states the pace to its switch, whose joins bring it upstream. From the reader's next report on it
governs no more. Each message then states the lowest pace of those whose path is free for it, and switches copy it to
branches of that pace and above (``frame/spec.md``). A path is free while what is under way would leave a queue of at
most ``_QUEUE_REPORTS`` delays of a report, or while no message of this topic is: other topics may fill the path for
long. So a slow reader gets the newest message each time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from gdp.client.blocking_readers import BlockingReaders, PathState
from gdp.client.reader_path import FLIGHT_FRAMES, ReaderPath, ReaderPaths
from gdp.frame.pace import pace_of
from gdp.limits import PACE_MAX, REPORT_DELAY_S
from gdp.message.heartbeat import PACES_MAX
from gdp.requests import Backoff

_MOVED_STEPS: Final = 3  # a rate that has changed by so many is another pace
_MOVED_REPORTS: Final = 100  # of full delay, after the one before
_SLOWED_REPORTS: Final = 25  # for which a reader holds back others while messages wait all the time
_QUEUE_REPORTS: Final = 4  # of what may be under way: else a path would be idle until the next message comes
_ALL: Final = 1 << 30
_FASTER: Final = 1.5  # times the rate of a reader that holds it back
# A queue that holds no whole message loses the end of each. Its reader governs again, for ever longer times.
_SHORT_LOSS, _SHORT_FRAMES = 0.15, 100
_GOVERNS: Final = Backoff(15.0, 240.0)


@dataclass(slots=True)
class _Given:
    """What one reader was given: a pace, when, and how often it proved to be wrong."""

    pace: int
    since_s: float
    governs_until_s: float = float("-inf")
    failures: int = 0


class ReaderPaces:
    """Paces of one publisher's readers.

    Attributes:
        stated: by reader, what its latest report says; readers that get everything are not in it.
        given: by reader, what it was given.
        slowing: readers that hold back others, while messages wait all the time.
        withheld: count of messages that were not for every reader.
        is_under_way: returns whether frames of this topic are under way to a reader.
    """

    def __init__(self, paths: ReaderPaths) -> None:
        self._paths = paths
        self.is_under_way: Callable[[bytes], bool] = lambda _name: True
        self.stated: dict[bytes, int] = {}
        self.given: dict[bytes, _Given] = {}
        self._begun: dict[bytes, int] = {}  # bytes of messages that begin now
        self.slowing = BlockingReaders(_SLOWED_REPORTS * REPORT_DELAY_S, most=_ALL, progress_bytes=float("inf"))
        self.withheld = 0

    def governing(self, names: list[bytes]) -> list[bytes]:
        """Return the readers of the highest pace that any has who confirms something."""
        if not self.stated or len(names) < 2:
            return names
        top = self._top(names)
        return [name for name in names if self._pace(name) == top]

    def handle_report(self, name: bytes, pace: int, now_s: float) -> bool:
        """Note the pace in a report, and follow the path's rate; return whether the reader is to be given another."""
        if pace < PACE_MAX:
            self.stated[name] = pace
        elif self.stated:
            self.stated.pop(name, None)
        given = self.given.get(name)
        if given is None or (path := self._paths.get(name)) is None:
            return pace != PACE_MAX
        model = path.controller.model
        if given.pace < PACE_MAX and given.pace == pace and now_s >= given.since_s + _MOVED_REPORTS * REPORT_DELAY_S:
            if model.loss >= _SHORT_LOSS:
                given.failures += 1
                given.pace, given.since_s = PACE_MAX, now_s
                given.governs_until_s = now_s + _GOVERNS.pause_s(given.failures)
            elif abs(pace_of(model.bytes_s) - pace) >= _MOVED_STEPS:
                given.pace, given.since_s = pace_of(model.bytes_s), now_s
        return given.pace != pace

    def record(self, names: Iterable[bytes], size: int, now_s: float) -> None:
        """Note which of the readers that govern hold back others, those with paces of their own included.

        ``size``: bytes that leave now. A path that permits no further frame then holds back what waits.
        """
        paths = {name: path for name in names if (path := self._paths.path(name, now_s)).governs_others}
        slowest = min((path.controller.model.bytes_s for path in paths.values()), default=0.0)
        states = [PathState(name, (path.allowance(now_s) - size) // path.mtu, 0) for name, path in paths.items()]
        faster = (path for path in self.paced() if path.controller.model.bytes_s >= _FASTER * slowest)
        states += [PathState(b"", 1, 0) for path in faster if path not in paths.values()]
        self.slowing.record(states, now_s)

    def slow_down(self, now_s: float) -> bool:
        """Give paces to the readers that hold back others; return whether one gets one."""
        return bool([name for name in self.slowing.slow(now_s) if self._give(name, now_s)])

    def rtt_s(self, name: bytes) -> float | None:
        """Return the round trip behind whole messages to a reader with a pace of its own; None: it has none."""
        path = self._paths.get(name) if name in self.stated else None
        return None if path is None else max(path.trip_s, path.controller.model.highest_s)

    def paced(self) -> list[ReaderPath]:
        """Return the paths to the readers with a pace of their own."""
        paths = (self._paths.get(name) for name in self.stated)
        return [path for path in paths if path is not None]

    def pace_of_lossy(self, names: Iterable[bytes], loss: float) -> int:
        """Return the lowest pace of the readers that lose as large a share of frames, 0 to 1; 0: of all."""
        if not self.stated:
            return 0
        paths = ((name, self._paths.get(name)) for name in names)
        lossy = [self._pace(name) for name, path in paths if path is not None and path.controller.model.loss >= loss]
        return min(lossy, default=0)

    def to_state(self) -> tuple[tuple[bytes, int], ...]:
        """Return the readers that are to state another pace to their switches."""
        new = [(name, each.pace) for name, each in self.given.items() if each.pace != self._pace(name)]
        new += [(name, PACE_MAX) for name in self.stated if name not in self.given]
        return tuple(new[:PACES_MAX])

    def take_back(self) -> None:
        """Take back what was given: all readers are to get everything."""
        self.given.clear()

    def keep(self, names: Iterable[bytes]) -> None:
        """Forget all readers but these."""
        gone = (self.given.keys() | self.stated.keys()) - set(names)
        for name in gone:
            self.given.pop(name, None)
            self.stated.pop(name, None)

    def begin_turn(self) -> None:
        """Note that what began before is under way."""
        self._begun.clear()

    def pace_for(self, names: Sequence[bytes], size: int) -> int:
        """Return the pace of a message of ``size`` bytes that begins to leave to these readers: 0: it is for all."""
        if not self.stated:
            return 0
        paces = sorted({self._pace(name) for name in names}, reverse=True)
        lowest = self._top(names)
        for pace in paces[paces.index(lowest) + 1 :]:
            members = [name for name in names if self._pace(name) == pace]
            if all(self._is_free(name) for name in members):
                lowest = pace
            elif any(self._gates(name) for name in members):
                break
        for name in names:
            if self._pace(name) >= lowest:
                self._begun[name] = self._begun.get(name, 0) + size
        if lowest == paces[-1]:
            return 0
        self.withheld += 1
        return lowest

    def _give(self, name: bytes, now_s: float) -> bool:
        path, given = self._paths.get(name), self.given.get(name)
        if path is None or not path.controller.model.bytes_s:
            return False
        if given is None:
            given = self.given[name] = _Given(PACE_MAX, now_s)
        if given.pace < PACE_MAX or now_s < given.governs_until_s:
            return False
        given.pace, given.since_s = pace_of(path.controller.model.bytes_s), now_s
        return True

    def _top(self, names: Iterable[bytes]) -> int:
        return max(([self._pace(n) for n in names if self._gates(n)] or [self._pace(n) for n in names]), default=0)

    def _pace(self, name: bytes) -> int:
        return self.stated.get(name, PACE_MAX)

    def _is_free(self, name: bytes) -> bool:
        """Return whether the path of a reader is to take another message."""
        path = self._paths.get(name)
        if path is None:
            return True
        model, under_way = path.controller.model, path.controller.rate.inflight + self._begun.get(name, 0)
        # a flight is confirmed with its last frame: the shortest round trip has the time that its bytes take
        trip_bytes = max(model.bytes_s * model.base_rtt_s - FLIGHT_FRAMES * path.mtu, 0.0)
        if under_way <= trip_bytes + model.bytes_s * _QUEUE_REPORTS * REPORT_DELAY_S:
            return True
        return name not in self._begun and not self.is_under_way(name)

    def _gates(self, name: bytes) -> bool:
        """Return whether slower readers wait for this one: not so if it confirms nothing."""
        path: ReaderPath | None = self._paths.get(name)
        return path is not None and path.governs_others
