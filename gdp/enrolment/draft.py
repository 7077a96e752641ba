"""Draft of a machine's directory: a private folder next to it, with reserved disk space, renamed as the last step.

I/O. A failure leaves nothing behind.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.stores.files import sync

RESERVED_BYTES: Final = 1 << 20
_RESERVE: Final = "reserved"


@contextlib.contextmanager
def draft_of(directory: Path) -> Iterator[Path]:
    """Yield a new private folder next to a directory; it is removed at the end if it was not renamed.

    Raises:
        LocalError: the system refuses.
    """
    draft = directory.parent / f".{directory.name}.{secrets.token_hex(8)}"
    try:
        directory.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
        draft.mkdir(mode=0o700)
    except OSError as error:
        raise LocalError(f"{directory.parent}: {error.strerror}; name another --directory") from error
    try:
        yield draft
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def reserve_space(draft: Path, consequence: str) -> Path:
    """Occupy the space of what will be written, so that a full disk is found first; return the file that does it.

    Args:
        consequence: what a person may rely on if the disk is full.

    Raises:
        LocalError: the disk is full.
    """
    path = draft / _RESERVE
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with os.fdopen(handle, "wb") as file:
            os.posix_fallocate(file.fileno(), 0, RESERVED_BYTES)
            os.fsync(file.fileno())
    except OSError as error:
        raise LocalError(
            f"{draft.parent}: {error.strerror}: this needs {RESERVED_BYTES >> 10} KiB; free some space, then run the"
            f" command again: {consequence}"
        ) from error
    return path


def publish_draft(draft: Path, directory: Path) -> None:
    """Rename a draft to its directory, also on the disk. Raises ``LocalError``: the system refuses."""
    try:
        draft.rename(directory)
        sync(directory.parent)
    except OSError as error:
        raise LocalError(f"{directory}: {error.strerror}; name another --directory") from error
