"""Power cuts while a holder or a writer puts records on the disk, at drawn points: what was confirmed is there."""

from __future__ import annotations

import os
import stat
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, TypeAlias
from unittest import mock

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.stores import capsule_store
from gdp.stores.capsule_ring import CapsuleRing
from gdp.stores.capsule_store import CapsuleStore, StoreLimits, stored
from tests.draws import draws
from tests.gdp.capsule.log import Log
from tests.gdp.capsule.owned import NOW_S, descriptor, writer

ABOUT: Final = descriptor()
WIRES: Final = Log(writer().key, ABOUT.name).add(60).closed().wires
DATA: Final = b"".join(WIRES)
LIMITS: Final = StoreLimits(owner_bytes=1 << 24, spare_bytes=0)
Cut: TypeAlias = tuple[int, int, float, bytes, bool]
FILE_BYTES: Final = 3_000  # so that writes begin files


class Disk:
    """A folder, and what of the writes since ``hold`` a power cut leaves."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._held: dict[Path, bytes] = {}

    def hold(self) -> None:
        """Keep what is on the disk: everything so far was flushed."""
        self._held = self._files()

    def cut(self, files: int, share: float, fill: bytes) -> None:
        """Cut the power while one of the files written since is flushed.

        Args:
            files: written files that are whole.
            share: of the new bytes of the next one that are on the disk.
            fill: a byte in place of the others; empty: they are not there.
        """
        now, held = self._files(), self._held
        for index, path in enumerate(sorted(path for path in now if now[path] != held.get(path))):
            before, after = held.get(path, b""), now[path]
            kept = len(before) + int(share * (len(after) - len(before)))
            if index == files:
                path.write_bytes(after[:kept] + fill * (len(after) - kept))
            elif index > files:
                path.unlink() if path not in held else path.write_bytes(before)

    def _files(self) -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in self._folder.rglob("*.records")}


def head_after(store: CapsuleStore, offset: int, data: bytes) -> int:
    """Append, and return the confirmed head."""
    request = HolderRequest(ask=Ask.APPEND, capsule=ABOUT.name, offset=offset, data=data, descriptor=ABOUT)
    return HolderAnswer.from_cbor(store.handle(request.to_cbor(), writer().name)).head


cuts = st.lists(
    st.tuples(
        st.integers(1, 4_000), st.integers(0, 3), st.floats(0, 1), st.sampled_from([b"", b"\0", b"x"]), st.booleans()
    ),
    min_size=1,
    max_size=6,
)


@given(cuts)
@example([(4_000, 0, 0.0, b"\0", True)])  # the first file of all has its length, and none of its bytes
@example([(4_000, 1, 0.0, b"\0", True)])  # the second one
@draws(15, long=200)
def test_a_holder_has_what_it_confirmed(tmp_path_factory: pytest.TempPathFactory, drawn: list[Cut]) -> None:
    folder = tmp_path_factory.mktemp("store")
    disk, head = Disk(folder), 0
    with mock.patch.object(capsule_store, "SEGMENT_BYTES", FILE_BYTES):
        for size, files, share, fill, has_index in drawn:
            store = CapsuleStore(folder, LIMITS, lambda: NOW_S)
            disk.hold()
            confirmed, head = head, head_after(store, head, DATA[head : head + size])
            disk.hold()
            head_after(store, head, DATA[head : head + 2 * FILE_BYTES])
            store.close()
            disk.cut(files, share, fill)
            if not has_index:
                for path in folder.glob("index.db*"):
                    path.unlink()
            store = CapsuleStore(folder, LIMITS, lambda: NOW_S)
            request = HolderRequest(ask=Ask.HEAD, capsule=ABOUT.name)
            found = HolderAnswer.from_cbor(store.handle(request.to_cbor(), writer().name)).head
            assert found >= head >= confirmed
            head = found
            store.close()
        store = CapsuleStore(folder, LIMITS, lambda: NOW_S)
        assert head_after(store, head, DATA[head:]) == len(DATA)
        store.close()
    (capsule,) = stored(folder)
    audit = capsule.audit()
    assert (audit.findings, audit.records) == ([], len(WIRES))


@given(st.integers(1, len(WIRES) - 1), st.integers(0, 2), st.floats(0, 1), st.sampled_from([b"", b"\0", b"x"]))
@draws(15, long=200)
def test_a_ring_continues_behind_what_was_on_the_disk(
    tmp_path_factory: pytest.TempPathFactory, count: int, files: int, share: float, fill: bytes
) -> None:
    folder, flushed = tmp_path_factory.mktemp("ring"), b"".join(WIRES[:count])
    disk = Disk(folder)
    with ThreadPoolExecutor(1) as pool:
        ring = CapsuleRing(folder, ABOUT, 1 << 20, pool)
        ring.append(flushed, begins_file=True)
        ring.close()
        disk.hold()
        ring = CapsuleRing(folder, ABOUT, 1 << 20, pool)
        ring.append(DATA[len(flushed) :], begins_file=False)
        ring.close()
        disk.cut(files, share, fill)
        ring = CapsuleRing(folder, ABOUT, 1 << 20, pool)
        ring.close()
        assert ring.descriptor == ABOUT
        assert ring.end >= len(flushed)
        assert ring.read(0, len(DATA)).result()[1] == DATA[: ring.end]


def test_a_dropped_segment_is_gone_from_the_disk_before_the_next_one(tmp_path: Path) -> None:
    """Else a power cut brings back an old one, with a gap behind it, as on ext4 without a journal."""
    store, steps = CapsuleStore(tmp_path, LIMITS, lambda: NOW_S), list[str]()
    with mock.patch.object(capsule_store, "SEGMENT_BYTES", FILE_BYTES):
        head_after(store, 0, DATA)
    (capsule,) = store.capsules
    store.limits = StoreLimits(owner_bytes=1 << 24, capsule_bytes=FILE_BYTES, spare_bytes=0)
    unlink, fsync = Path.unlink, os.fsync

    def unlinks(path: Path, **keys: bool) -> None:
        steps.append("unlink")
        unlink(path, **keys)

    def syncs(handle: int) -> None:
        steps.append("sync" if stat.S_ISDIR(os.fstat(handle).st_mode) else "file")
        fsync(handle)

    with mock.patch.object(Path, "unlink", unlinks), mock.patch.object(os, "fsync", syncs):
        store.retire(capsule)
    store.close()
    assert len(steps) > 2
    assert steps == ["unlink", "sync"] * (len(steps) // 2)
