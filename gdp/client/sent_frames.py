"""Ledger of the frames that one publisher has sent, until its readers' reports show what became of them.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

A report states how many frames its reader has received, and the newest of them. Frames keep their order on a path. So
everything that left up to that frame has arrived or is lost, and the count shows how many are lost. Frames that leave
at once form flights of at most ``FLIGHT_FRAMES``; a flight is confirmed as a whole. A frame that is sent again gives
no round trip, because its confirmation may be that of the first time (Karn's rule).

Each frame is entered once, when it leaves. What a report shows of it is handed to the path of its reader
(``reader_path.py``), to the check of receipts (``gdp/message/receipts.py``) and to the estimate of loss
(``gdp/message/frame_loss.py``).
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

from gdp import burst
from gdp.client.reader_path import FLIGHT_FRAMES, ReaderPath, ReaderPaths
from gdp.congestion.delivery_rate import Flight
from gdp.frame.codec import NUMBER_AND_PART, NUMBER_AT, PACE_AT
from gdp.message.acknack import AckNack
from gdp.message.frame_loss import FrameLoss
from gdp.message.receipts import ReceiptCheck

_MESSAGES_MAX: Final = 1 << 16
_COUNT_MASK: Final = (1 << 32) - 1


# Fragment of a message; the one up to which the others left right after it; count of frames sent up to the first one;
# whether they were sent again.
_Run = tuple[int, int, int, bool]


@dataclass(slots=True)
class _Reader:
    """What one reader has not confirmed yet."""

    flights: deque[Flight] = field(default_factory=deque)
    resolved: int = 0  # count of frames whose fate is known
    received: int = -1  # count in its latest report; -1: none yet
    newest: tuple[int, int] = (0, 0)  # message and fragment in its latest report
    partial: int = 0  # frames of the oldest flight that came, of frames sent again
    unseen: int = 0  # frames sent before it began to count, or not to it
    withheld: deque[tuple[int, int]] = field(default_factory=deque)  # frames not sent to it, with the count of all then
    repairs: int = 0  # frames sent again to several readers, which are in no flight
    lost: int = 0
    receipts: ReceiptCheck = field(default_factory=ReceiptCheck)


class SentFrames:
    """Ledger of the frames of one publisher.

    Args:
        paths: of the participant.
        counts_losses: frames keep their order; not so if they are striped over two paths.
        paces: of readers that do not get frames of a higher pace, by name; it changes as they state others.

    Attributes:
        loss: share of urgent frames lost, copies included.
        last_s: when frames other than copies last left.
        leaving: what ``count`` is to enter by ``sent``, so that the frames need not wait for that; None: nothing.
    """

    def __init__(
        self, paths: ReaderPaths, *, counts_losses: bool = True, paces: Mapping[bytes, int] | None = None
    ) -> None:
        self._paths = paths
        self._paces = {} if paces is None else paces
        self._counts_losses = counts_losses
        self.leaving: tuple[Sequence[bytes], Sequence[bytes], float, int] | None = None
        self.loss = FrameLoss()
        self.last_s = float("-inf")
        self._readers: dict[bytes, _Reader] = {}
        self._count = 0
        self._runs = defaultdict[int, list[_Run]](list)  # by message number; oldest first
        self._uncounted: dict[int, set[int]] = {}  # fragments sent again to several readers: they give no round trip

    @property
    def is_unconfirmed(self) -> bool:
        """Return whether frames have left of which some reader's reports do not show yet what became of them."""
        return any(reader.flights for reader in self._readers.values())

    def count(self) -> None:
        """Enter the frames that left last."""
        leaving, self.leaving = self.leaving, None
        if leaving is not None:
            self.sent(*leaving)

    def sent(self, frames: Sequence[bytes], names: Sequence[bytes], now_s: float, again: int = 0) -> None:
        """Count frames that leave now to the readers of these names; the first ``again`` of them were sent before.

        Of several readers, those that have a frame already do not confirm it again. It then counts for the pace alone.
        """
        readers = len(names)
        if len(self._readers) > readers:
            self.keep(names)
        if again and readers > 1:
            for name in names:
                repairs = frames[:again]
                if name in self._paces:
                    repairs = [frame for frame in repairs if frame[PACE_AT] <= self._paces[name]]
                samples = burst.samples(repairs, 0, len(repairs)) if self._counts_losses else ()
                self._paths.path(name, now_s).controller.pace.charge(sum(map(len, repairs)), now_s)
                if name in self._readers:
                    self._readers[name].repairs += len(repairs)
                    self._readers[name].receipts.sent(samples, 0, is_repair=True)
            for frame in frames[:again]:
                number, part = NUMBER_AND_PART.unpack_from(frame, NUMBER_AT)
                if number in self._runs:
                    self._uncounted.setdefault(number, set()).add(part)
            frames, again = frames[again:], 0
        if again:
            for run in self._of_one_pace(frames[:again]) if self._paces else (frames[:again],):
                self._add(run, names, now_s, is_repair=True)
            frames = frames[again:]
        if frames:
            for run in self._of_one_pace(frames) if self._paces else (frames,):
                self._add(run, names, now_s, is_repair=False)
        if not readers or (frames and len(self._runs) > _MESSAGES_MAX):
            self._forget_places()

    def _add(self, frames: Sequence[bytes], names: Sequence[bytes], now_s: float, *, is_repair: bool) -> None:
        """Count frames that all leave for the first time, or all again, at one pace."""
        before, paths, count = self._count, self._paths, len(frames)
        samples = burst.samples(frames, 0, count) if self._counts_losses else ()  # striped ones would prove no order
        sizes: list[tuple[int, int]] = []
        for at in range(0, count, FLIGHT_FRAMES):
            left = count - at
            size = sum(map(len, frames[at : at + FLIGHT_FRAMES]))
            sizes.append((size, left if left < FLIGHT_FRAMES else FLIGHT_FRAMES))
        self._count += count
        self._note_places(frames, count, before + 1, is_repair=is_repair)
        for name in names:
            if name not in self._readers:
                self._readers[name] = _Reader(resolved=before)
            path, reader, place = paths.path(name, now_s), self._readers[name], before
            if name in self._paces and frames[0][PACE_AT] > self._paces[name]:
                reader.withheld.append((self._count, count))
                continue
            if samples:
                reader.receipts.sent(samples, before + 1, is_repair=is_repair)
            for size, of_flight in sizes:
                record = path.sent(size, of_flight, now_s)
                place += of_flight
                record.place, record.is_repair = place, is_repair
                reader.flights.append(record)
                paths.leaving.append(record)

    def _of_one_pace(self, frames: Sequence[bytes]) -> Iterator[Sequence[bytes]]:
        """Yield runs of frames that state one pace."""
        begin = 0
        for end in range(1, len(frames) + 1):
            if end == len(frames) or frames[end][PACE_AT] != frames[begin][PACE_AT]:
                yield frames[begin:end]
                begin = end

    def _note_places(self, frames: Sequence[bytes], count: int, place: int, *, is_repair: bool) -> None:
        """Note the counts of frames that leave; ``place`` is the first one's."""
        number, part = last_number, last_part = NUMBER_AND_PART.unpack_from(frames[0], NUMBER_AT)
        if count > 1:
            last_number, last_part = NUMBER_AND_PART.unpack_from(frames[-1], NUMBER_AT)
        if not is_repair and number == last_number and last_part - part == count - 1:  # of one message, in order
            self._runs[number].append((part, last_part, place, False))
            return
        for each, frame in enumerate(frames, place):
            number, part = NUMBER_AND_PART.unpack_from(frame, NUMBER_AT)
            self._runs[number].append((part, part, each, is_repair))

    def _find(self, number: int, part: int) -> tuple[int, bool]:
        """Return the count of frames sent up to a frame, 0 if not known any more, and whether it was sent again.

        A reader requests a frame when it would have come already. So of one that was sent again, the last one came.
        """
        for first, last, place, is_repair in reversed(self._runs[number]) if number in self._runs else ():
            if first <= part <= last:
                return place + part - first, is_repair or part in self._uncounted.get(number, ())
        return 0, False

    def handle_report(
        self, name: bytes, acknack: AckNack, now_s: float, waited_s: float = 0.0, hops: int | None = None
    ) -> bool:
        """Confirm on the reader's path what a report shows, which came ``waited_s`` before.

        Args:
            hops: that it had left when it came by the first path; None: it came by the second one.

        Returns:
            whether its receipts prove fewer frames than it counts.
        """
        is_unproven = False
        reader, path = self._readers.get(name), self._paths.get(name)
        if path is not None:
            path.controller.model.add_wait(waited_s)
            if hops is not None:
                path.handle_hops(hops, now_s)
            if reader is not None and acknack.received:
                is_unproven = self._confirm(reader, path, acknack, now_s, waited_s)
                self._forget_places()
            path.handle_heard(now_s)
        return is_unproven

    def _confirm(self, reader: _Reader, path: ReaderPath, acknack: AckNack, now_s: float, waited_s: float) -> bool:
        while reader.flights and not reader.flights[0].is_under_way:
            reader.resolved, reader.partial = reader.flights.popleft().place, 0  # it was given up with a silence
        came = (acknack.received - reader.received) & _COUNT_MASK if reader.received >= 0 else 0
        has_begun = reader.received < 0 or came > _COUNT_MASK // 2
        newest = acknack.newest, acknack.newest_part
        (place, is_repair), is_newer = self._find(*newest), newest != reader.newest
        reader.received, reader.newest = acknack.received, newest
        if has_begun:
            reader.receipts.begin(acknack.receipts, place)
        if not is_newer:
            self._confirm_repairs(reader, path, 0 if has_begun else came, place, now_s)
        if not is_newer or place <= reader.resolved:  # what came now was given up before
            return False
        before, confirmed, reader.partial = reader.resolved, list[Flight](), 0
        while reader.flights and reader.flights[0].place <= place:
            confirmed.append(reader.flights.popleft())
            reader.resolved = confirmed[-1].place
        while reader.withheld and reader.withheld[0][0] <= place:
            reader.unseen += reader.withheld.popleft()[1]
        if has_begun:
            reader.unseen, reader.lost = (place - acknack.received) & _COUNT_MASK, 0
        held_s = None if is_repair else acknack.held_us / 1e6 + waited_s
        if not confirmed:
            if reader.flights and reader.flights[0].place - reader.flights[0].frames < place:  # a part of it came
                path.handle_part(reader.flights[0], held_s, now_s)
            return False
        lost = (place - reader.unseen - acknack.received) & _COUNT_MASK
        lost = 0 if lost > _COUNT_MASK // 2 else lost
        new_lost = lost - reader.lost if lost > reader.lost else 0
        reader.lost += new_lost
        frames = sum(flight.frames for flight in confirmed) if self._paces else reader.resolved - before
        judged = reader.receipts.judge(acknack.receipts, place, frames, new_lost) if self._counts_losses else 0
        is_unproven = judged > new_lost
        if is_unproven and held_s is not None:
            held_s = waited_s  # nor is it believed how long it held its report
        path.handle_held(acknack.held_us / 1e6)
        path.acknowledged(confirmed, max(min(judged, frames - 1), 0) if judged else 0, held_s, now_s)
        return is_unproven

    def _confirm_repairs(self, reader: _Reader, path: ReaderPath, came: int, place: int, now_s: float) -> None:
        """Confirm frames that came, though none was newer than before: they were sent again.

        Frames that left for the first time before them would have come first, so they are lost. A report by which
        nothing more came shows that the rest of a flight is lost. Else a flight that lost its end would block the
        window until the timeout. Repairs to several readers are in no flight, and confirm as many frames that left for
        the first time. Without a repair under way, what came is of flights that were given up. It confirms no later
        one: each would then be confirmed by the report of the one before, and no round trip be measured.
        """
        is_over = not came and reader.partial > 0
        came += reader.partial
        confirmed, lost = list[Flight](), 0
        while reader.flights:
            flight = reader.flights[0]
            size = flight.place - reader.resolved
            if not flight.is_repair and came and any(each.is_repair for each in reader.flights):
                lost += flight.place - max(reader.resolved, place)
            elif not flight.is_repair and not reader.repairs:
                came = 0
                break
            elif size > came and not is_over:
                break
            else:
                came, is_over = max(came - size, 0), False
                reader.repairs -= 0 if flight.is_repair else min(size, reader.repairs)
            reader.flights.popleft()
            reader.resolved = flight.place
            confirmed.append(flight)
        reader.partial = came if reader.flights else 0
        reader.lost += lost
        if confirmed:
            path.acknowledged(confirmed, lost if self._counts_losses else 0, None, now_s)

    def is_under_way(self, name: bytes) -> bool:
        """Return whether frames are under way to a reader, as far as known here."""
        reader = self._readers.get(name)
        return reader is not None and any(flight.is_under_way for flight in reader.flights)

    def keep(self, readers: Iterable[bytes]) -> None:
        """Take off the account what is under way to other readers than these: it will not be confirmed."""
        for name in self._readers.keys() - set(readers):
            path, reader = self._paths.get(name), self._readers.pop(name)
            if path is not None:
                path.controller.rate.forget(reader.flights)

    def _forget_places(self) -> None:
        """Forget the places in messages that every reader has confirmed, and in the oldest of too many."""
        below, gone, spare = self._count, 0, len(self._runs) - _MESSAGES_MAX
        for reader in self._readers.values():
            below = reader.resolved if reader.resolved < below else below
        for runs in self._runs.values():
            first, last, place, _ = runs[-1]
            if place + last - first > below and gone >= spare:
                break
            gone += 1
        for number in [*islice(self._runs, gone)]:
            del self._runs[number]
            if self._uncounted:
                self._uncounted.pop(number, None)
