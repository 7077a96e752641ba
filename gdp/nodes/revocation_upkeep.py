"""Persistence of a node's revocations across restarts: loaded at the start, written when they change.

I/O.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from itertools import islice
from pathlib import Path

from gdp.crypto.statements import parse
from gdp.errors import RemoteError
from gdp.intervals import PACE_S
from gdp.sansio import Timestamps
from gdp.stores.revocation_file import SLICE, RevocationFile
from gdp.trust.revocations import Revocations

__all__ = ["RevocationUpkeep"]

log = logging.getLogger(__name__)


class RevocationUpkeep:
    """Upkeep of one node's revocations.

    Args:
        folder: the node's state folder; None: they are kept in memory only.

    Raises:
        LocalError: others may write to the folder.
    """

    def __init__(self, folder: Path | None, revoked: Revocations) -> None:
        self._file = None if folder is None else RevocationFile(folder)
        self._revoked = revoked

    def restore(self, at: Timestamps) -> None:
        """Restore the revocations of earlier runs, each statement verified."""
        if self._file is None:
            return
        refused = 0
        for row in self._file.load(at.unix_s):
            try:
                self._revoked.restore(parse(row.statement), row.origin, at, of_root=row.is_root)
            except RemoteError:
                refused += 1
        self._revoked.changes = set()
        log.info("revocations read kept=%d refused=%d", len(self._revoked), refused)

    def start(self, every: Callable[[float, Callable[[Timestamps], None]], None] | None = None) -> None:
        """Begin to write; call it after the confinement of rights, which applies only to threads started later.

        Args:
            every: of a loop, which calls ``work`` from now on; None: the caller does.
        """
        if self._file is not None:
            self._file.start()
            if every is not None:
                every(PACE_S, self.work)

    def work(self, at: Timestamps) -> None:
        """Pass one slice of changes to the file, if it is ready."""
        del at
        changes = self._revoked.changes
        if changes and self._file is not None and self._file.is_ready:
            keys = list(islice(changes, SLICE))
            changes.difference_update(keys)
            self._file.write([(key, self._revoked.kept(key)) for key in keys])

    def close(self) -> None:
        """Write the remaining changes, and end."""
        if self._file is None:
            return
        while self._revoked.changes and self._file.is_ready:
            self.work(Timestamps(0.0, 0.0))
        self._file.close()
