"""Upkeep of a RIB's store: a snapshot kept current, or a cluster listened to.

I/O.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Final, Protocol

from gdp.ports.plane import HasFileno
from gdp.rib.core import RibCore
from gdp.rib.store import MemoryStore, Store
from gdp.sansio import Timestamps
from gdp.stores.snapshot import SLICE, Snapshot

__all__ = ["MemoryUpkeep", "Upkeep"]

log = logging.getLogger(__name__)

SNAPSHOT_S: Final = 0.1  # between two slices
CHANGES_MAX: Final = 65_536  # that wait for disk space, or twice the number of kept routes


class Upkeep(Protocol):
    """Upkeep of one store."""

    @property
    def store(self) -> Store:
        """Return the store."""

    @property
    def every_s(self) -> float:
        """Return the period of ``work``, in seconds."""

    def begin(self, rib: RibCore, now: Timestamps) -> None:
        """Fill the store with what an earlier run stored."""

    def sources(self) -> Sequence[HasFileno]:
        """Return the sources that make ``work`` due when they are readable."""

    def work(self, now: Timestamps) -> None:
        """Do what is due."""

    def close(self) -> None:
        """End the upkeep."""


class MemoryUpkeep:
    """A store in memory, with a snapshot on disk if there is a path for it."""

    def __init__(self, path: Path | None) -> None:
        self._memory = MemoryStore()
        self._snapshot = None if path is None else Snapshot(path)
        self._rib: RibCore | None = None

    @property
    def store(self) -> Store:
        """Return the store."""
        return self._memory

    @property
    def every_s(self) -> float:
        """Return the period in seconds at which a slice of changes is passed on."""
        return SNAPSHOT_S

    def begin(self, rib: RibCore, now: Timestamps) -> None:
        """Load the snapshot, whose entries are verified again."""
        self._rib = rib
        if self._snapshot is None:
            return
        live = sum(rib.load(entries, now) for entries in self._snapshot.load(now.unix_s))
        log.info(
            "snapshot read live=%d unreadable=%d refused=%d", live, self._snapshot.unreadable, rib.refusals.total()
        )
        self._memory.changes = set()
        self._snapshot.start()

    def sources(self) -> Sequence[HasFileno]:
        """Return no sources."""
        return ()

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
        snapshot.write([(key, rib.entry_of(key, now.mono_s)) for key in keys], now.unix_s)

    def close(self) -> None:
        """Write the changes that wait in the snapshot's queue."""
        if self._snapshot is not None:
            self._snapshot.close()
