"""Paths to the readers of one publisher: which of them govern what leaves, how much may leave, and what is measured.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). The slowest reader that keeps up governs; of requests the
fastest does, because the first answer counts. ``reader_path.py`` has the path to one reader node, which all publishers
of a participant share.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from typing import Final

from gdp.client.blocking_readers import BlockingReaders, PathState
from gdp.client.reader_paces import ReaderPaces
from gdp.client.reader_path import ReaderPath, ReaderPaths
from gdp.client.reader_proxies import ReaderProxies
from gdp.client.send_options import PublisherSettings, SendOptions
from gdp.client.send_queue import SendQueue
from gdp.frame.codec import NUMBER_AND_PART, NUMBER_AT
from gdp.intervals import NEVER_S
from gdp.limits import SPREAD
from gdp.message.send_window import SendWindow
from gdp.names import Name
from gdp.token_bucket import TokenBucket

_ALL: Final = 1 << 30
_ALONE_FROM_S: Final = 1.0  # after a second path: round trips enough to measure the one that remains
_LIMIT_BURST_S: Final = 0.05  # of ``max_bits_s``: a burst of this time leaves at once


class GoverningPaths:
    """Paths to the readers of one publisher.

    Args:
        paths: what may leave to each reader node; shared by all publishers of a participant.
        settings: of the publisher; urgent frames find space where those of other topics have filled the window.

    Attributes:
        blocking: readers that hold back the others.
        paces: of the readers of a best-effort topic, each of which has its own.
        share: of what the path carries, 0 to 1; the other topics that wait have the rest.
        seen_s: when ``allowance`` was last asked.
        second_until_s: monotonic second until which there is a second path, as far as known here.
        limit_bytes_s: bytes a second that may leave by the settings; None: any.
    """

    def __init__(
        self,
        *,
        paths: ReaderPaths,
        readers: ReaderProxies,
        queue: SendQueue,
        window: SendWindow,
        settings: PublisherSettings,
    ) -> None:
        self._paths = paths
        self._readers = readers
        self._queue = queue
        self._window = window
        self._count, self._is_urgent = settings.paths, settings.urgent
        self._fastest_governs = settings.patience.fastest_governs
        self.blocking = BlockingReaders(settings.patience.lag_s)
        self.paces = ReaderPaces(paths)
        self._may_pace = settings.paths == 1 and not settings.urgent and not settings.patience.fastest_governs
        queue.pace_of = self._begin
        self.seen_s = 0.0
        self.share = 1.0
        self.second_until_s = float("-inf")
        self.limit_bytes_s: float | None = None
        self._only: tuple[list[bytes], list[ReaderPath]] = ([], [])  # the only reader, and its path
        self._only_at = -1  # ... as long as nothing has changed since
        self._limit: TokenBucket | None = None
        self.set_options(settings.options)

    def set_options(self, options: SendOptions) -> None:
        """Change how many bits may leave in a second, and whether readers may have paces."""
        if not options.own_pace:
            self.paces.take_back()
        bytes_s = None if options.max_bits_s is None else options.max_bits_s / 8
        if bytes_s != self.limit_bytes_s:
            self._limit = None if bytes_s is None else TokenBucket(bytes_s, max(bytes_s * _LIMIT_BURST_S, 1.0))
            self.limit_bytes_s = bytes_s

    def has_second(self, now_s: float) -> bool:
        """Return whether frames are to leave by two paths, and there are two."""
        return self._count > 1 and now_s < self.second_until_s

    def is_doubled(self, now_s: float) -> bool:
        """Return whether each frame travels over two paths now."""
        return self._count not in (1, SPREAD) and now_s < self.second_until_s

    def allowance(self, now_s: float) -> int:
        """Return how many bytes of frames may leave now, as far as the paths permit; 0: none.

        Of a topic that sends each frame over two paths, the round trip changes with the path whose copy comes first. So
        no path governs it while there are two. When one ends, the other has carried every frame, but is not measured:
        the first window would delay messages that fit it. It governs a second later.
        """
        if self._limit is not None and self._limit.left(now_s) <= 0:
            return 0
        self.seen_s, urgent = now_s, self._is_urgent
        if self._count > 1 and self.is_doubled(now_s - _ALONE_FROM_S):
            return _ALL
        paths = self._governing()
        if paths and not paths[1:] and not self.blocking.blocks:
            return paths[0].allowance(now_s, urgent=urgent)
        allowances = [path.allowance(now_s, urgent=urgent) for path in paths]
        if self._fastest_governs:
            return max(allowances, default=_ALL)
        if self.blocking.blocks or (len(allowances) > 1 and min(allowances) <= 0):
            self._record_blocks(now_s)
        return min(allowances, default=_ALL)

    def record_waiting(self, size: int, now_s: float) -> None:
        """Note which readers hold back the others, for more waits than the ``size`` bytes that leave now.

        A path may permit a little at each turn, if turns are rare: what counts is what it permits beyond that.
        """
        if self._may_pace and self._queue.options.own_pace and not self._queue.is_acknowledged:
            self.paces.record(self.names(), size, now_s)

    def allowance_of_all(self, now_s: float) -> int:
        """Return how many bytes of frames may leave on each of the paths; 0: none."""
        return min((path.allowance(now_s) for path in self._governing()), default=0)

    def next_send_s(self, now_s: float) -> float | None:
        """Return when ``allowance`` may be more than 0; None: not before a reader confirms something."""
        governs = min if self._fastest_governs else max
        due_s = governs((path.next_send_s() for path in self._governing()), default=now_s)
        if self._limit is not None and (left := self._limit.left(now_s)) <= 0:
            due_s = max(due_s, now_s + self._limit.seconds_for(1 - left))
        return None if due_s == NEVER_S else due_s

    def is_limited(self, now_s: float) -> bool:
        """Return whether messages wait now because ``max_bits_s`` lets no frame leave."""
        return self._limit is not None and not self._queue.is_empty and self._limit.left(now_s) <= 0

    def charge_limit(self, frames: Iterable[bytes], now_s: float) -> None:
        """Take the bytes of messages and parity that leave from what ``max_bits_s`` permits."""
        if self._limit is not None and (size := sum(map(len, frames))):
            self._limit.charge(now_s, size)

    def charge(self, size: int, now_s: float) -> None:
        """Delay what follows by the time that bytes take which no reader confirms."""
        for path in self._governing():
            path.controller.pace.charge(size, now_s)

    def awaited_readers(self) -> frozenset[bytes]:
        """Return the readers whose paths must all permit a frame at once; empty: there is one path."""
        names = self.names()
        return frozenset(names) if len(names) > 1 and not self._fastest_governs else frozenset()

    def note_idle(self) -> None:
        """Note that nothing waits, though the paths may permit more."""
        for path in self._governing():
            path.controller.app_limited()

    @property
    def bytes_s(self) -> float | None:
        """Return the bytes a second that this topic may expect of its path; None: not measured, and no limit."""
        rate = 0.0
        for path in self._measured():
            measured = path.controller.model.bytes_s
            rate = measured if measured and (not rate or measured < rate) else rate
        if not rate or self.limit_bytes_s is None:
            return rate * self.share if rate else self.limit_bytes_s
        return min(rate * self.share, self.limit_bytes_s)

    @property
    def capacity_bytes_s(self) -> float | None:
        """Return how many bytes a second the narrowest path carries; None: not measured."""
        rates = [path.controller.model.capacity_bytes_s for path in self._measured()]
        return min([rate for rate in rates if rate], default=None)

    @property
    def loss(self) -> float:
        """Return the share of frames that were lost lately on the worst path, 0 to 1; 0 also if nothing is measured."""
        return max([path.controller.model.loss for path in (*self._measured(), *self.paces.paced())], default=0.0)

    @property
    def rtt_s(self) -> float | None:
        """Return the smoothed round trip of the longest path in seconds; None: not measured."""
        trips = [path.controller.model.rtt_s for path in self._measured()]
        return max([trip for trip in trips if trip is not None], default=None)

    @property
    def base_rtt_s(self) -> float | None:
        """Return the round trip of the longest path while it is empty, in seconds; None: not measured."""
        longest_s: float | None = None
        for path in self._measured():
            model = path.controller.model
            if model.rtt_s is not None and (longest_s is None or model.base_rtt_s > longest_s):
                longest_s = model.base_rtt_s
        return longest_s

    def patience_s(self, now_s: float) -> float:
        """Return how long the answer of the slowest reader may take."""
        return max((path.patience_s(now_s) for path in self._governing()), default=0.0)

    def governing_reader(self) -> tuple[Name, float, float] | None:
        """Return the slowest of several readers, its round trip in seconds, and its bytes a second, or None."""
        names = self.names()
        paths = {name: path for name in names if (path := self._paths.get(name)) is not None and path.trip_s}
        if len(names) < 2 or not paths or self._fastest_governs:
            return None
        name = min(paths, key=lambda each: paths[each].allowed_bytes_s)
        return Name(name), paths[name].trip_s, paths[name].allowed_bytes_s

    def measured_readers(self) -> Container[bytes]:
        """Return the readers whose losses protection is for: where the fastest governs, its own alone."""
        return self.fastest() if self._fastest_governs else self._readers.active

    def fastest(self) -> list[bytes]:
        """Return the reader whose path is the shortest; none of none."""
        return self._paths.fastest(self.names(), self.seen_s)

    def names(self) -> list[bytes]:
        """Return the readers that keep up: the others must not wait for one that does not. Without any, return all.

        A best-effort reader whose program is slow drops frames itself, which costs no other. One behind a thin link
        keeps up as long as that link carries something, because frames beyond its rate would harm all who share it.
        """
        names, now_s = self._present(), self.seen_s
        if len(names) < 2:
            return names
        if self._queue.is_acknowledged:
            window, following = self._window, self._queue.sent[0]
            keeping_up = [each for each in names if each in window.readers.active]
            return [each for each in keeping_up if not window.readers.is_ahead(each, following)] or keeping_up or names
        readers, paths = self._readers.active, self._paths
        names = [each for each in names if now_s >= readers[each].out_until_s and not paths.is_behind(each)] or names
        return self.paces.governing(names)

    def confirming(self, frames: Sequence[bytes], again: int) -> list[bytes]:
        """Return the readers that confirm these frames, the first ``again`` of which are repairs.

        One that began with a later message than the last of them does not.
        """
        if self._only_at == self._readers.changes + self._paths.changes:
            return self._only[0]
        names, window = self._present(), self._window
        if len(frames) <= again or len(names) < 2 or not self._queue.is_acknowledged:
            return names
        number, _ = NUMBER_AND_PART.unpack_from(frames[-1], NUMBER_AT)
        return [name for name in names if not window.readers.is_ahead(name, number)]

    def _present(self) -> list[bytes]:
        """Return the readers whose nodes have not started again since they began to read. Without any, return all."""
        readers, is_former = self._readers.active, self._paths.is_former
        everyone = [*readers]
        if len(everyone) < 2:
            return everyone
        return [name for name in everyone if not is_former(name, readers[name].incarnation_id.started)] or everyone

    def _governing(self) -> list[ReaderPath]:
        """Return the paths to the readers that may govern, the slowest of which does; of requests the fastest does."""
        if self._only_at == self._readers.changes + self._paths.changes:
            return self._only[1]
        names = self.names()
        paths = self._paths.governing(names, self.seen_s)
        if len(self._readers.active) == 1:
            self._only, self._only_at = (names, paths), self._readers.changes + self._paths.changes
        return paths

    def _measured(self) -> list[ReaderPath]:
        return self._paths.governing(self.fastest(), self.seen_s) if self._fastest_governs else self._governing()

    def _record_blocks(self, now_s: float) -> None:
        """Note which readers hold back the others."""
        paths = ((name, self._paths.path(name, now_s)) for name in self.names())
        present = [(name, path) for name, path in paths if path.governs_others]
        self.blocking.record([PathState(name, path.allowance(now_s), path.sent_bytes) for name, path in present], now_s)

    def _begin(self, size: int) -> int:
        """Return the pace of a best-effort message of ``size`` bytes that begins to leave."""
        return self.paces.pace_for(self._present(), size) if self.paces.stated else 0
