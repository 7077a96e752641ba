"""Bucket of a holder: closed segments go to it, and open ones that age; the disk is a cache of what it has.

I/O; a thread of its own waits for the bucket. A record is confirmed to its writer when the bucket has it, so a holder
with an empty disk serves all that was confirmed. Keys are ``holder`` (who uses the prefix), ``CAPSULE/descriptor.cbor``
and ``CAPSULE/OFFSET.records``. The index has the tag of each object: another one is an object that was exchanged, and
is read again. What of it is not the writer's is a gap, which this disk or another holder fills.
"""

from __future__ import annotations

import json
import logging
import secrets
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from typing import Final

from gdp.capsule.chain import Chain
from gdp.capsule.descriptor import Descriptor
from gdp.capsule.record import split
from gdp.closing import ClosedOnExit
from gdp.errors import GdpError, LocalError, RemoteError, StoreError
from gdp.intervals import HOUR_S, MINUTE_S, STOP_S, UPKEEP_S
from gdp.names import ZERO, Name
from gdp.requests import Backoff
from gdp.stores.bucket import Bucket, ChangedError, StoredObject
from gdp.stores.bucket_folder import object_key
from gdp.stores.capsule_ring import DESCRIPTOR
from gdp.stores.capsule_store import CapsuleStore, StoredCapsule, object_of, objects_of
from gdp.stores.segments import SUFFIX

log = logging.getLogger(__name__)

_CLAIM: Final = "holder"
_READERS_MAX: Final = 2  # at once, so that others of the holder's workers stay free
_PACE: Final = Backoff(UPKEEP_S, MINUTE_S)


class BucketUpkeep(ClosedOnExit):
    """Bucket of one store.

    Args:
        age_s: an open segment is uploaded so long after the first record that the bucket lacks.
    """

    def __init__(self, store: CapsuleStore, bucket: Bucket, age_s: float = MINUTE_S) -> None:
        self._store, self._bucket, self._age_s = store, bucket, age_s
        self._lacking_s: dict[Name, float] = {}  # since when the bucket lacks records of an open segment
        self._claim = ""  # tag of ours
        self._listed_s = 0.0
        self._readers = threading.BoundedSemaphore(_READERS_MAX)
        self._is_closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="bucket", daemon=True)

    def open(self, holder: Name, *, takes: bool = False) -> None:
        """Use the bucket for this holder, and restore what it has and the disk lacks.

        Args:
            takes: also if another holder has used it.

        Raises:
            GdpError: the bucket is another holder's, refuses, or cannot be reached.
        """
        self._take(holder, takes=takes)
        self._compare()

    def start(self) -> None:
        """Upload from now on."""
        self._thread.start()

    def close(self) -> None:
        """End the thread; what the bucket lacks stays on the disk."""
        self._is_closing.set()
        if self._thread.is_alive():
            self._thread.join(STOP_S)

    def run_round(self, now_s: float) -> None:
        """Upload what is due, remove what was dropped or has no space, and compare all with the list each hour.

        Raises:
            GdpError: the bucket refuses or cannot be reached, or is another holder's now.
        """
        is_checked = False
        for capsule in self._store.capsules:
            segments = capsule.segments
            segments.fetch = partial(self._fetch, capsule)
            for offset in self._due(capsule, now_s):
                if not is_checked:
                    self._check_claim()
                    is_checked = True
                if not segments.size_of(offset):
                    self._bucket.delete(object_key(capsule.name, offset))
                    self._set(capsule, offset, None)
                elif self._is_closing.is_set() or not self._upload(capsule, offset):
                    break  # what follows is not confirmed before it
        self._evict()
        if now_s >= self._listed_s + HOUR_S:
            self._check_claim()
            self._compare()
            self._listed_s = now_s

    def _work(self) -> None:
        failures = 0
        self._listed_s = time.monotonic()
        while not self._is_closing.wait(_PACE.pause_s(failures)):
            try:
                self.run_round(time.monotonic())
            except (GdpError, OSError) as error:
                failures += 1
                self._store.note(ZERO, f"the bucket lacks records, which stay on this disk: {error}")
            else:
                if failures:
                    self._store.note(ZERO, "the bucket takes records again")
                failures = 0

    def _take(self, holder: Name, *, takes: bool) -> None:
        found = self._bucket.get(_CLAIM)
        owner = holder.to_text() if found is None else _holder_of(found[0])
        if owner != holder.to_text() and not takes:
            raise LocalError(f"{self._bucket.url}: holder {owner} uses it; give each holder a prefix of its own, or"
                             " take it with --take-bucket if that holder is gone")  # fmt: skip
        claim = json.dumps({"holder": holder.to_text(), "run": secrets.token_hex(8)}).encode()
        try:
            self._claim = self._bucket.put(_CLAIM, claim, None if found is None else found[1])
            self._check_claim()
        except ChangedError as error:
            raise StoreError(f"{self._bucket.url}: another holder begins to use it now") from error

    def _check_claim(self) -> None:
        if self._store.refusal:
            raise StoreError(self._store.refusal)
        found = self._bucket.get(_CLAIM)
        if found is None or found[1] != self._claim:
            who = "another holder" if found is None else f"holder {_holder_of(found[0])}"
            self._store.refusal = f"{self._bucket.url}: {who} uses it now; this one takes no records any more"
            raise StoreError(self._store.refusal)

    def _due(self, capsule: StoredCapsule, now_s: float) -> list[int]:
        """Return the segments to upload now, and those that were dropped, in order; only changed ones are looked at."""
        segments, lacking = capsule.segments, list[int]()
        for offset in sorted(segments.changed.copy()):
            with self._store.lock:  # nothing is appended meanwhile
                known, size = object_of(self._store.index, capsule.name, offset), segments.size_of(offset)
                if offset in segments.absent or size == (0 if known is None else known.size):
                    segments.changed.discard(offset)
                else:
                    lacking.append(offset)
        if segments.last not in lacking:
            self._lacking_s.pop(capsule.name, None)
        elif now_s < self._lacking_s.setdefault(capsule.name, now_s) + self._age_s:
            lacking.remove(segments.last)
        return lacking

    def _upload(self, capsule: StoredCapsule, offset: int) -> bool:
        """Have a segment in the bucket as it is now; return whether that was possible."""
        segments, name, index = capsule.segments, capsule.name, self._store.index
        size = segments.size_of(offset)
        data = segments.read(offset, size)[1]
        if not size or len(data) != size or proven_bytes(capsule, data) != size:
            self._store.note(name, f"the segment at {offset} is damaged, so the bucket does not get it")
            return False
        with index.reading() as open_index:
            has_objects = open_index.execute("SELECT 1 FROM objects WHERE capsule = ? LIMIT 1", (name,)).fetchone()
        if has_objects is None:
            self._put(f"{name.to_text()}/{DESCRIPTOR}", capsule.descriptor.to_cbor(), None)
        before = object_of(index, name, offset)
        tag = self._put(object_key(name, offset), data, None if before is None else before.tag)
        self._set(capsule, offset, StoredObject(size, tag))
        capsule.backed = max(capsule.backed or 0, offset + size)
        if offset == segments.last:
            self._lacking_s.pop(name, None)
        return True

    def _put(self, key: str, data: bytes, replaces: str | None) -> str:
        """Write an object; one that is there and was not known, as after a crash, is replaced, too."""
        try:
            return self._bucket.put(key, data, replaces)
        except ChangedError:
            self._check_claim()
            found = self._bucket.get(key)
            if found is not None and found[0] == data:
                return found[1]
            log.warning("object replaced that was exchanged key=%s", key)
            return self._bucket.put(key, data, None if found is None else found[1])

    def _fetch(self, capsule: StoredCapsule, offset: int) -> bytes:
        """Return a segment that the bucket has; it is on the disk then.

        Raises:
            StoreError: the bucket does not give it, or others wait for the bucket.
        """
        if not self._readers.acquire(blocking=False):
            raise StoreError(f"{self._bucket.url}: it is slow, and others wait for it; try again")
        try:
            size, known = capsule.segments.size_of(offset), object_of(self._store.index, capsule.name, offset)
            found = self._bucket.get(object_key(capsule.name, offset))
            data, tag = found or (b"", "")
            if known is not None and tag != known.tag:
                self._judge(capsule, offset, known, found)
                size = capsule.segments.size_of(offset)
            if not size or proven_bytes(capsule, data[:size]) < size:
                raise StoreError(f"{capsule.name.short}: the bucket does not have the segment at {offset} any more")
        finally:
            self._readers.release()
        self._evict(size)
        capsule.segments.keep_fetched(offset, data[:size])
        return data[:size]

    def _compare(self) -> None:
        """Compare the list of the bucket with what it was given; restore what is not here."""
        listed: dict[Name, dict[int, StoredObject]] = {}
        for key, found in self._bucket.list():
            folder, _, file = key.partition("/")
            with suppress(ValueError, LocalError):
                if file.endswith(SUFFIX):
                    listed.setdefault(Name.from_text(folder), {})[int(file.removesuffix(SUFFIX), 16)] = found
        capsules = {each.name: each for each in self._store.capsules}
        for name in listed.keys() - capsules.keys():
            try:
                found_one = self._bucket.get(f"{name.to_text()}/{DESCRIPTOR}")
                descriptor = Descriptor.from_cbor(b"" if found_one is None else found_one[0])
                if descriptor.name != name:
                    raise LocalError("its descriptor is another one's")
                capsules[name] = self._store.adopt(descriptor, has_quota=False)
                log.info("capsule restored name=%s objects=%d", name.short, len(listed[name]))
            except (RemoteError, LocalError) as error:
                self._store.note(name, f"not restored from the bucket: {error}")
        for name, capsule in capsules.items():
            self._compare_capsule(capsule, listed.get(name, {}))
        self._evict()

    def _compare_capsule(self, capsule: StoredCapsule, listed: Mapping[int, StoredObject]) -> None:
        segments, known = capsule.segments, objects_of(self._store.index, capsule.name)
        segments.fetch = partial(self._fetch, capsule)
        before = segments.end
        for offset in sorted({*known, *listed}):
            found, given = listed.get(offset), known.get(offset)
            if found is not None and found == given:
                self._store.take_backed(capsule, offset, found.size)
            else:
                self._judge(capsule, offset, given, self._bucket.get(object_key(capsule.name, offset)))
        if segments.end != before:
            self._store.resume(capsule)
        last = next(reversed(objects_of(self._store.index, capsule.name).items()), None)
        capsule.backed = max(capsule.backed or 0, 0 if last is None else last[0] + last[1].size)

    def _judge(
        self, capsule: StoredCapsule, offset: int, given: StoredObject | None, found: tuple[bytes, str] | None
    ) -> None:
        """Take as much of an object that is not known as is the writer's; name it where another one was given."""
        segments, (data, tag) = capsule.segments, found or (b"", "")
        size = proven_bytes(capsule, data)
        here_bytes = 0 if offset in segments.absent else segments.size_of(offset)
        here = segments.read(offset, here_bytes)[1] if here_bytes else b""
        is_whole = 0 < size == len(data) and (data.startswith(here) or here.startswith(data))
        if given is not None and (size <= given.size or not is_whole):
            what = "gone" if found is None else f"exchanged: {size} bytes of {given.size} are the writer's"
            self._store.note(capsule.name, f"the bucket's segment at {offset} is {what}")
        elif not is_whole:
            self._store.note(capsule.name, f"the bucket's segment at {offset} is damaged behind {size} bytes")
        self._set(capsule, offset, StoredObject(size, tag) if is_whole else None)
        self._store.take_backed(capsule, offset, size, data[:size])

    def _set(self, capsule: StoredCapsule, offset: int, found: StoredObject | None) -> None:
        with self._store.index.writing() as index:
            index.execute("DELETE FROM objects WHERE capsule = ? AND offset = ?", (capsule.name, offset))
            if found is not None:
                index.execute("INSERT INTO objects VALUES (?, ?, ?, ?)", (capsule.name, offset, *found))
        capsule.segments.changed.add(offset)

    def _evict(self, more: int = 0) -> None:
        """Remove segments that the bucket has, those first that came first, until the cache has space."""
        most = self._store.limits.cache_bytes or 0
        excess = sum(each.segments.here_bytes for each in self._store.capsules) + more - most
        if excess <= 0:
            return
        found = [
            (each.segments.age_of(offset), each, offset)
            for each in self._store.capsules
            for offset in each.segments.offsets
            if offset not in each.segments.absent
        ]
        for _, capsule, offset in sorted(found, key=lambda each: each[0]):
            if excess <= 0:
                return
            known = object_of(self._store.index, capsule.name, offset)
            with self._store.lock:
                size, is_last = capsule.segments.size_of(offset), offset == capsule.segments.last
                is_backed = known is not None and known.size == size
                if is_backed and not is_last and offset not in capsule.segments.absent:
                    capsule.segments.evict(offset)
                    excess -= size


def proven_bytes(capsule: StoredCapsule, data: bytes) -> int:
    """Return how many bytes of a segment are whole records that continue its first checkpoint."""
    chain, end = Chain(capsule.name, capsule.descriptor.key), 0
    with suppress(RemoteError):
        for wire in split(data):
            chain.handle_record(wire, may_skip=not end)
            end += len(wire)
    return end


def _holder_of(claim: bytes) -> str:
    try:
        return str(json.loads(claim)["holder"])
    except (ValueError, TypeError, KeyError):
        return "unknown"
