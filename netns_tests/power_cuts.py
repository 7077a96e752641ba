"""Power of a disk that is cut at drawn moments, while a holder and a robot's ring write to it.

I/O; needs root. Real file systems stand on loop devices, in a mount namespace of this process, which ends with it. A
volume is a file on the disk, and the page cache of the disk's own file system is the cache of that disk: it keeps a
write only after a flush, or where the drawn ranges were written back. XFS clones the whole disk between two of its
writes (FICLONE). The clone has what a power cut leaves, and is mounted like a disk after one.
"""

from __future__ import annotations

import fcntl
import json
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from gdp.capsule.descriptor import Descriptor
from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.record import Record, RecordType
from gdp.stores import capsule_ring, capsule_store
from gdp.stores.capsule_ring import CapsuleRing
from gdp.stores.capsule_store import CapsuleStore, StoreLimits
from tests.gdp.capsule.log import Log
from tests.gdp.capsule.owned import NOW_S, descriptor, writer

FORMATS: Final = {
    "ext4": (["mkfs.ext4", "-q", "-F"], ""),
    "ext4, data=writeback": (["mkfs.ext4", "-q", "-F"], "data=writeback"),
    "ext4 without a journal": (["mkfs.ext4", "-q", "-F", "-O", "^has_journal"], ""),
    "xfs": (["mkfs.xfs", "-q", "--unsupported"], "nouuid"),  # of less than 300 MB
}
VOLUME_BYTES: Final = 32 << 20
KEPT_BYTES, FILE_BYTES, RING_BYTES = 12_000, 3_000, 24_000
LIMITS: Final = StoreLimits(owner_bytes=1 << 30, capsule_bytes=KEPT_BYTES, spare_bytes=0)
CAPSULES, MESSAGES = 4, 150
_FICLONE: Final = 0x40049409
_PIECE_BYTES: Final = 64 << 10
History = tuple[Descriptor, list[bytes]]
Confirmed = dict[tuple[str, int], int]  # offset behind the last byte, by who confirmed it and the number of the capsule


def run(*argv: str | Path) -> None:
    """Run a command. Raises ``OSError``: it fails."""
    done = subprocess.run(list(map(str, argv)), capture_output=True, check=False, text=True)
    if done.returncode:
        raise OSError(f"{' '.join(map(str, argv))}: {done.stderr.strip()}")


@contextmanager
def mounted(image: Path, at: Path, options: str = "") -> Iterator[Path]:
    """Mount a file on a loop device, which goes with the mount."""
    at.mkdir(exist_ok=True)
    run("mount", "-o", ",".join(filter(None, ["loop", options])), image, at)
    try:
        yield at
    finally:
        run("umount", at)


def history(number: int) -> History:
    """Return a capsule and its records."""
    about = replace(descriptor(), begun_ms=NOW_S * 1_000 + number)
    return about, Log(writer().key, about.name).add(MESSAGES).closed().wires


def ask(store: CapsuleStore, ask: Ask, about: Descriptor, offset: int = 0, data: bytes = b"") -> HolderAnswer:
    """Return a holder's answer to the writer."""
    request = HolderRequest(ask=ask, capsule=about.name, offset=offset, data=data, descriptor=about)
    return HolderAnswer.from_cbor(store.handle(request.to_cbor(), writer().name))


def write(folder: Path, histories: list[History], rng: random.Random, to: Connection) -> None:
    """Write all histories to a ring and to a holder, and say after each write what is confirmed."""
    with ThreadPoolExecutor(1) as pool, CapsuleStore(folder / "holder", LIMITS, lambda: NOW_S) as store:
        for number, (about, records) in enumerate(histories):
            ring, at = CapsuleRing(folder / "ring" / str(number), about, RING_BYTES, pool), 0
            wires = records
            while wires:
                begins_file, count = ring.wants_file and is_checkpoint(wires[0]), 1
                most = rng.randrange(1, 12)
                while count < min(most, len(wires)) and not (ring.wants_file and is_checkpoint(wires[count])):
                    count += 1
                data, wires = b"".join(wires[:count]), wires[count:]
                ring.append(data, begins_file=begins_file)
                middle = rng.randrange(len(data))
                for first, end in ((0, middle), (middle, len(data))):
                    head = ask(store, Ask.APPEND, about, at + first, data[first:end]).head
                    to.send([("holder", number, head)])
                pool.submit(lambda: None).result()  # it has written
                to.send([("ring", number, ring.end)])
                at += len(data)
            ring.close()
    to.send([])


def is_checkpoint(wire: bytes) -> bool:
    """Return whether a record is a checkpoint."""
    return Record.from_wire(wire).type is RecordType.CHECKPOINT


def rows(store: CapsuleStore) -> list[tuple[object, ...]]:
    """Return what the index has of the segments that are there."""
    with store.index.reading() as index:
        found = [
            row
            for each in sorted(store.capsules, key=lambda each: each.name)
            for row in index.execute(
                "SELECT capsule, offset, number, time_ns FROM checkpoints WHERE capsule = ? AND offset >= ?"
                " ORDER BY offset",
                (each.name, each.segments.begin),
            )
        ]
    return [tuple(row) for row in found]


def check(folder: Path, histories: list[History], confirmed: Confirmed) -> Iterator[str]:
    """Open what a power cut has left, and yield what is wrong."""
    for path in folder.rglob("*"):
        if path.is_file():
            path.read_bytes()
    with CapsuleStore(folder / "holder", LIMITS, lambda: NOW_S) as store:
        known = {each.name: each for each in store.capsules}
        if len(known) != len(list((folder / "holder").glob(f"*/{capsule_ring.DESCRIPTOR}"))) or store.poll_faults():
            yield "holder: a capsule cannot be read"
        for (who, number), end in confirmed.items():
            about, data = histories[number][0], b"".join(histories[number][1])
            if who == "holder":
                if (capsule := known.get(about.name)) is None:
                    yield f"holder: capsule {number} is lost, {end} bytes were confirmed"
                    continue
                begin, head = capsule.segments.begin, ask(store, Ask.HEAD, about).head
                pieces, at = list[bytes](), begin
                while piece := ask(store, Ask.READ, about, at).data:
                    pieces.append(piece)
                    at += len(piece)
                if (
                    head < end
                    or begin > max(head - KEPT_BYTES + 2 * FILE_BYTES, 0)
                    or b"".join(pieces) != data[begin:head]
                ):
                    files = [(each, capsule.segments.size_of(each)) for each in capsule.segments.offsets]
                    yield f"holder: capsule {number} has {files}, {end} bytes were confirmed"
                elif capsule.audit().findings:
                    yield f"holder: capsule {number}: {[each.words() for each in capsule.audit().findings]}"
                elif head < len(data) and ask(store, Ask.APPEND, about, head, data[head : head + 2_000]).head <= head:
                    yield f"holder: capsule {number} takes no more"
            else:
                with ThreadPoolExecutor(1) as pool:
                    ring = CapsuleRing(folder / "ring" / str(number), replace(about, begun_ms=1), RING_BYTES, pool)
                    found = ring.read(ring.begin, len(data)).result()[1]
                    ring.close()
                least = ring.begin <= max(ring.end - RING_BYTES + 2 * FILE_BYTES, 0)
                if ring.descriptor != about or ring.end < end or not data[ring.begin :].startswith(found) or not least:
                    yield f"ring: capsule {number} has {ring.begin} to {ring.end}, {end} bytes were on the disk"
        indexed = rows(store)
    for path in (folder / "holder").glob("index.db*"):
        path.unlink()
    with CapsuleStore(folder / "holder", LIMITS, lambda: NOW_S) as store:
        if indexed != rows(store):
            yield "holder: the index has other checkpoints than the segments"


class Disk:
    """Disk with a volume, and copies of it as of a power cut."""

    def __init__(self, base: Path, disk: Path, kind: str) -> None:
        self._base, self._disk, self._kind = base, disk, kind

    def cut(self, rng: random.Random) -> None:
        """Copy what is on the disk, after its cache has written back drawn ranges."""
        with (self._disk / "volume").open("rb") as volume:
            for _ in range(rng.randrange(8)):
                at = rng.randrange(VOLUME_BYTES // _PIECE_BYTES) * _PIECE_BYTES
                os.posix_fadvise(
                    volume.fileno(), at, rng.choice([4_096, _PIECE_BYTES, 1 << 23]), os.POSIX_FADV_DONTNEED
                )
        with (self._base / "disk").open("rb") as now, (self._base / "cut").open("wb") as copy:
            fcntl.ioctl(copy, _FICLONE, now.fileno())

    def check(self, histories: list[History], confirmed: Confirmed) -> list[str]:
        """Return what is wrong on the copy."""
        with mounted(self._base / "cut", self._base.parent / "old-disk") as disk:
            if "journal" in self._kind:  # as each boot does
                repaired = subprocess.run(["e2fsck", "-fy", disk / "volume"], capture_output=True, check=False)
                assert repaired.returncode < 4, repaired
            with mounted(disk / "volume", self._base.parent / "old", FORMATS[self._kind][1]) as folder:
                return list(check(folder, histories, confirmed))


def cut_often(kind: str, cuts: int, seed: int, scratch: Path) -> Generator[str, None, None]:
    """Cut the power ``cuts`` times, and yield what was wrong."""
    make, options = FORMATS[kind]
    rng, histories = random.Random(seed), [history(number) for number in range(CAPSULES)]
    done = 0
    with mounted(scratch / "base", scratch / "xfs") as base:
        while done < cuts:
            with (base / "disk").open("wb") as file:
                file.truncate(3 * VOLUME_BYTES // 2)
            run("mkfs.ext4", "-q", "-F", "-O", "^has_journal", base / "disk")
            with mounted(base / "disk", scratch / "disk") as place:
                (place / "volume").write_bytes(bytes(VOLUME_BYTES))
                run(*make, place / "volume")
                os.sync()
                with mounted(place / "volume", scratch / "volume", options) as folder:
                    disk = Disk(base, place, kind)
                    with closing(cut_writer(disk, folder, histories, rng, cuts - done)) as moments:
                        for found in moments:
                            done += 1
                            yield from (f"{kind}, seed {seed}, cut {done}: {each}" for each in found)


def cut_writer(
    disk: Disk, folder: Path, histories: list[History], rng: random.Random, most: int
) -> Generator[list[str], None, None]:
    """Cut the power of a writer at most so many times, until it has written all; yield what was wrong each time."""
    hears, says = multiprocessing.Pipe(duplex=False)
    words = (folder, histories, random.Random(rng.random()), says)
    child = multiprocessing.get_context("fork").Process(target=write, args=words, daemon=True)
    child.start()
    assert child.pid is not None
    says.close()
    confirmed, has_ended = Confirmed(), False

    def hear() -> None:
        nonlocal has_ended
        news = hears.recv()
        confirmed.update({(who, number): end for who, number, end in news})
        has_ended = not news

    try:
        for _ in range(most):
            for _ in range(rng.randrange(1, 12)):
                if not has_ended:
                    hear()
            time.sleep(rng.uniform(0, 0.004))  # the moment is drawn
            while not has_ended and hears.poll():
                hear()
            if has_ended:
                break
            disk.cut(rng)
            os.kill(child.pid, signal.SIGSTOP)
            yield disk.check(histories, confirmed)
            os.kill(child.pid, signal.SIGCONT)
    finally:
        child.kill()
        child.join()
        hears.close()


def main(scratch: str, cuts: str, seed: str, broken: str = "") -> None:
    """Print, as JSON, why no file system can be mounted here, or what was wrong and how often the power was cut.

    ``cuts``: of each file system. ``broken``: a function of ``os`` that does nothing; then it ends at the first fault.
    """
    folder = Path(scratch)
    for module in (capsule_store, capsule_ring):
        setattr(module, "SEGMENT_BYTES", FILE_BYTES)  # noqa: B010
    if broken:
        setattr(os, broken, lambda _handle: None)
    try:
        missing = [each for each in ("mkfs.xfs", "mkfs.ext4", "e2fsck") if shutil.which(each) is None]
        if missing:
            raise OSError(f"{', '.join(missing)}: not installed (xfsprogs, e2fsprogs)")
        folder.mkdir()
        run("mount", "-t", "tmpfs", "power", folder)
        with (folder / "base").open("wb") as file:
            file.truncate(20 * VOLUME_BYTES)
        run("mkfs.xfs", "-q", folder / "base")
        with mounted(folder / "base", folder / "xfs"):
            pass
    except OSError as error:
        print(json.dumps({"refused": str(error)}))
        return
    for kind in FORMATS:
        with closing(cut_often(kind, int(cuts), int(seed), folder)) as found:
            for wrong in found:
                print(json.dumps({"wrong": wrong}), flush=True)
                if broken:
                    return
        print(json.dumps({"cuts": int(cuts)}))
