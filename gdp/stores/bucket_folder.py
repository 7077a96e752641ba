"""Folder of a holder whose segments are in a bucket, for commands while that holder does not run.

I/O. The file ``bucket`` has the URL. The index says what the bucket was given, so only records are read from there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Final

from gdp.errors import LocalError, StoreError
from gdp.names import Name
from gdp.stores.bucket import Bucket
from gdp.stores.capsule_store import StoredCapsule, index_of, objects_of, remove, stored
from gdp.stores.files import private, read_private, write_all
from gdp.stores.segments import SUFFIX

_PLACE: Final = "bucket"


def object_key(name: Name, offset: int) -> str:
    """Return the key of the segment that begins at an offset."""
    return f"{name.to_text()}/{offset:016x}{SUFFIX}"


def refuse_other_place(folder: Path, url: str | None) -> None:
    """Check that a holder's folder has its segments in this bucket. Raises ``LocalError``: another one has them."""
    known = _place_of(folder)
    if known not in (None, url):
        raise LocalError(f"{folder}: its segments are in {known}; name that bucket")


def note_place(folder: Path, url: str) -> None:
    """Note which bucket has the segments of a holder's folder. Raises ``LocalError``: the system refuses."""
    write_all(folder, {_PLACE: private(url.encode())}, force=True)


def stored_with_bucket(folder: Path) -> Iterator[StoredCapsule]:
    """Yield the capsules of a store, also what its bucket has of them; records are read from there."""
    url = _place_of(folder)
    opened = cache(Bucket)
    for capsule in stored(folder):
        if url is not None:
            with index_of(folder) as index:
                known_objects = objects_of(index, capsule.name)
            for offset, known in known_objects.items():
                if not capsule.segments.size_of(offset):
                    capsule.segments.set_absent(offset, known.size)
            capsule.segments.fetch = partial(_read_from, opened, url, capsule.name)
        yield capsule


def _read_from(opened: Callable[[str], Bucket], url: str, name: Name, offset: int) -> bytes:
    found = opened(url).get(object_key(name, offset))
    if found is None:
        raise StoreError(f"{url}: {object_key(name, offset)}: there is no such object")
    return found[0]


def remove_with_bucket(folder: Path, name: Name) -> None:
    """Remove a capsule from a store whose holder does not run, and from its bucket before. Raises ``GdpError``."""
    url = _place_of(folder)
    if url is not None:
        with Bucket(url) as bucket:
            for key, _ in list(bucket.list(f"{name.to_text()}/")):
                bucket.delete(key)
    remove(folder, name)


def _place_of(folder: Path) -> str | None:
    return read_private(folder / _PLACE).decode() if (folder / _PLACE).exists() else None
