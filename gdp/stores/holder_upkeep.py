"""Upkeep of a holder: exchange with other holders, and scrubbing, which reads all segments again and has them repaired.

I/O, by its store; time comes in as ``now_s`` (monotonic seconds). Each turn reads one batch: a round takes 2 seconds
for each MiB of the store, and the next one begins an hour later.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from gdp.capsule.chain import Chain
from gdp.capsule.holder import BATCH_BYTES
from gdp.capsule.record import split
from gdp.errors import DropReason, GdpError, RemoteError
from gdp.intervals import HOUR_S, MINUTE_S, UPKEEP_S
from gdp.names import Name
from gdp.requests import Backoff, Requests
from gdp.stores.capsule_store import CapsuleStore, StoredCapsule
from gdp.stores.holder_exchange import Steps, equalise, repair

_SCRUB: Final = ""  # among the work, in place of a holder
_PACE: Final = Backoff(UPKEEP_S, MINUTE_S)


class HolderUpkeep:
    """Upkeep of one store.

    Args:
        holders: services of the other holders, which have the same capsules.
    """

    def __init__(self, store: CapsuleStore, holders: Sequence[str], now_s: float) -> None:
        self._store = store
        self._holders = holders
        self._work = Requests[str]()
        for work in (_SCRUB, *holders):
            self._work.start(work, now_s)
        self._scrubbing = self._scrub()
        self._doubted = {holder: set[Name]() for holder in holders}
        self._unasked: dict[tuple[StoredCapsule, int], list[str]] = {}  # for the repair of a segment

    def handle_timer(self, now_s: float) -> list[tuple[str, Steps]]:
        """Read a batch again; return the exchanges that begin now, each with its holder.

        The caller calls ``ended`` for each of them whose last request was answered.
        """
        due = self._work.poll_due(now_s)
        for work in due:
            self._work.sent(work, now_s, _PACE)
        if _SCRUB in due:
            has_more = next(self._scrubbing, False)
            self._work.answered(_SCRUB, now_s + (UPKEEP_S if has_more else HOUR_S))
            self._scrubbing = self._scrubbing if has_more else self._scrub()
        return [(holder, self._exchange(holder)) for holder in due if holder != _SCRUB]

    def ended(self, holder: str, now_s: float) -> None:
        """Note that an exchange has ended; the next one is due soon."""
        self._work.answered(holder, now_s + UPKEEP_S)

    def _exchange(self, holder: str) -> Steps:
        for capsule in self._store.capsules:
            for offset in self._store.gaps(capsule):
                self._unasked.setdefault((capsule, offset), list(self._holders))
        for (capsule, offset), unasked in list(self._unasked.items()):
            if holder in unasked:
                try:
                    yield from repair(self._store, capsule, offset, holder)
                except GdpError as error:
                    self._store.note(capsule.name, f"the segment at {offset} is not repaired from {holder}: {error}")
                unasked.remove(holder)
        yield from equalise(self._store, holder, self._doubted[holder])

    def _scrub(self) -> Iterator[bool]:
        self._unasked.clear()
        for capsule in self._store.capsules:
            self._store.retire(capsule)
            yield from self._check(capsule)

    def _check(self, capsule: StoredCapsule) -> Iterator[bool]:
        """Verify the segments of one capsule."""
        chain = None
        for offset in capsule.segments.offsets:
            if offset in capsule.segments.absent:  # the bucket's own list says whether it has what it was given
                chain = None
                continue
            chain = chain or Chain(capsule.name, capsule.descriptor.key)
            try:
                for _ in _verified(capsule, offset, chain):
                    yield True
            except GdpError as error:
                chain = None
                if self._is_fetched(capsule, offset):
                    self._store.note(capsule.name, f"the segment at {offset} is repaired from the bucket: {error}")
                elif offset in capsule.segments.offsets:
                    self._unasked[capsule, offset] = list(self._holders)
                    self._store.note(capsule.name, f"the segment at {offset} is damaged: {error}")

    def _is_fetched(self, capsule: StoredCapsule, offset: int) -> bool:
        try:
            return self._store.fetch_again(capsule, offset)
        except GdpError as error:
            self._store.note(capsule.name, f"the segment at {offset} is not repaired from the bucket: {error}")
            return False


def _verified(capsule: StoredCapsule, offset: int, chain: Chain) -> Iterator[None]:
    """Read a segment, a batch at a time. Raises ``GdpError``: it is damaged, or the disk does not read it."""
    segments, data, parsed = capsule.segments, b"", 0
    at = offset
    while at < (end := offset + segments.size_of(offset)):
        yield
        begin, more = segments.read(at, min(BATCH_BYTES, end - at))
        if begin != at or not more:
            raise RemoteError(DropReason.MALFORMED, f"it ends at {at}, not at {end}")
        is_first, data, parsed = at == offset, data[parsed:] + more, 0
        at += len(more)
        for wire in split(data):
            chain.handle_record(wire, may_skip=is_first)
            is_first, parsed = False, parsed + len(wire)
    if parsed < len(data):
        raise RemoteError(DropReason.MALFORMED, "its last record has no end")
