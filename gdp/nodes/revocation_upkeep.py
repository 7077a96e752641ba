"""Persistence of a node's revocations across restarts: loaded at the start, written when they change."""

from __future__ import annotations

import logging
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from gdp.crypto.statements import parse
from gdp.errors import RemoteError
from gdp.sansio import Timestamps
from gdp.trust.revocations import Revocations

if TYPE_CHECKING:
    from gdp.stores.revocation_file import RevocationFile

log = logging.getLogger(__name__)


class RevocationUpkeep:
    """Upkeep of one node's revocations.

    Args:
        folder: the node's state folder; None: they are kept in memory only.

    Raises:
        LocalError: others may write to the folder.
    """

    def __init__(self, folder: Path | None, revoked: Revocations) -> None:
        self._file: RevocationFile | None = None
        if folder is not None:
            from gdp.stores.revocation_file import RevocationFile  # it loads a database

            self._file = RevocationFile(folder)
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

    def start(self) -> None:
        """Begin to write; call it after the confinement of rights, which applies only to threads started later."""
        if self._file is not None:
            self._file.start()

    def has_work(self) -> bool:
        """Return whether there are changes to write."""
        return self._file is not None and bool(self._revoked.changes)

    def work(self, at: Timestamps) -> None:
        """Pass one slice of changes to the file, if it is ready."""
        del at
        changes = self._revoked.changes
        if changes and self._file is not None and self._file.is_ready:
            from gdp.stores.revocation_file import SLICE

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
