"""Upkeep of a RIB's store: a snapshot kept current, or a cluster listened to."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Final

from gdp.intervals import PACE_S
from gdp.ports.plane import HasFileno
from gdp.rib.core import RibCore
from gdp.rib.store import MemoryStore, Store
from gdp.sansio import Timestamps
from gdp.stores.snapshot import SLICE, Snapshot

log = logging.getLogger(__name__)

CHANGES_MAX: Final = 65_536  # that wait for disk space, or twice the number of kept routes


class Upkeep:
    """Upkeep of one store.

    Attributes:
        every_s: period of ``work``, in seconds.
        sources: make ``work`` due when they are readable.
    """

    store: Store
    every_s: float
    sources: Sequence[HasFileno] = ()

    def start(self, rib: RibCore, now: Timestamps) -> None:
        """Fill the store with what an earlier run stored."""

    def work(self, now: Timestamps) -> None:
        """Do what is due."""

    def has_work(self) -> bool:
        """Return whether ``work`` has to be called."""
        return True

    def close(self) -> None:
        """End the upkeep."""


class MemoryUpkeep(Upkeep):
    """A store in memory, with a snapshot on disk if there is a path for it; a period passes on a slice of changes."""

    every_s = PACE_S

    def __init__(self, path: Path | None) -> None:
        self.store = self._memory = MemoryStore()
        self._snapshot = None if path is None else Snapshot(path)
        self._rib: RibCore | None = None

    def start(self, rib: RibCore, now: Timestamps) -> None:
        """Load the snapshot, whose entries are verified again."""
        self._rib = rib
        if self._snapshot is None:
            return
        live = sum(rib.load(entries, now) for entries in self._snapshot.load(now.unix_s))
        refused = rib.state.refusals.total()
        log.info("snapshot read live=%d unreadable=%d refused=%d", live, self._snapshot.unreadable, refused)
        self._memory.changes = set()
        self._snapshot.start()

    def work(self, now: Timestamps) -> None:
        """Pass one slice of changes to the snapshot, if it is ready."""
        changes, snapshot, rib = self._memory.changes, self._snapshot, self._rib
        if changes is None or snapshot is None or rib is None or not changes:
            return
        if not snapshot.is_ready:
            if len(changes) > CHANGES_MAX and len(changes) > 2 * sum(1 for _ in self._memory.known()):
                snapshot.begin_again()  # most of the changes concern names that are gone
                self._memory.changes = set(self._memory.known())
            return
        keys = list(islice(changes, SLICE))
        changes.difference_update(keys)
        snapshot.write([(key, rib.state.entry_of(key, now.mono_s)) for key in keys], now.unix_s)

    def has_work(self) -> bool:
        """Return whether there are changes for the snapshot."""
        return self._snapshot is not None and bool(self._memory.changes)

    def close(self) -> None:
        """Write the changes that wait in the snapshot's queue."""
        if self._snapshot is not None:
            self._snapshot.close()
