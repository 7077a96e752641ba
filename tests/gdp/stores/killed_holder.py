"""Holder that dies at its nth step towards the disk or the bucket: FOLDER PREFIX N CAPSULE_BYTES.

The folder has the records and their descriptor, and gets the store. It prints each confirmed head.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import pytest

from gdp.capsule.descriptor import Descriptor
from gdp.capsule.holder import Ask
from gdp.stores.bucket import Bucket
from gdp.stores.bucket_upkeep import BucketUpkeep
from gdp.stores.segments import Segments
from tests.gdp.stores.bucket_sites import LIMITS, BackedSite, short_segments

T = TypeVar("T")


class Steps:
    """Steps that are left until the end."""

    def __init__(self, left: int) -> None:
        self.left = left

    def step(self) -> None:
        """Take one."""
        self.left -= 1
        if self.left == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    def around(self, done: Callable[..., T]) -> Callable[..., T]:
        """Return a function with a step before it and one behind it."""

        def wrapped(*args: object, **keys: object) -> T:
            self.step()
            result = done(*args, **keys)
            self.step()
            return result

        return wrapped


def main(folder: Path, prefix: str, left: int, capsule_bytes: int) -> None:
    """Append and upload all records."""
    about, data = Descriptor.from_cbor((folder / "descriptor").read_bytes()), (folder / "records").read_bytes()
    steps = Steps(left)
    for owner, names in (
        (Bucket, ("put", "delete")),
        (BucketUpkeep, ("_set",)),
        (Segments, ("evict", "drop", "append", "keep_fetched")),
    ):
        for name in names:
            setattr(owner, name, steps.around(getattr(owner, name)))
    short_segments(pytest.MonkeyPatch())
    limits = replace(LIMITS, cache_bytes=12_000, capsule_bytes=capsule_bytes or None)
    site = BackedSite(folder / "store", prefix, limits, about=about)
    at = site.ask(Ask.HEAD).offset if site.store.capsules else 0
    while at < len(data):
        at = site.append(data[at : at + 1_500], at).offset
        print(site.round(), flush=True)
        assert site.data == data[site.begin : site.capsule.segments.end]
    site.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
