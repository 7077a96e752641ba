"""BPF maps of the kernel as mappings from bytes to bytes.

I/O; one file descriptor per map.
Source: bpf(2); Linux, Documentation/bpf/map_hash.rst and map_array.rst. A per-CPU value is as many values as there may
be CPUs, each padded to 8 bytes.
"""

from __future__ import annotations

import errno
import mmap
import os
import resource
import struct
import sys
from collections.abc import Sequence
from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import Final

from gdp.ports.kernel.syscall import BATCH, NAME_MAX, BpfError, Command, address, bpf

# BPF_F_NO_PREALLOC: an entry costs memory only while it exists. From Linux 6.1 on, the kernel may reuse a removed or
# replaced element at once, while a frame in progress still reads it. For some nanoseconds that frame may see the port
# of one entry and the addresses of another. Then one sealed frame is misdelivered, and only its reader can open it.
# Preallocation does not help: the kernel has always reused preallocated elements at once, and the usual table would
# cost 18 MB.
_NO_PREALLOC: Final = 1
_MAPPABLE: Final = 1 << 10  # BPF_F_MMAPABLE
_POSSIBLE: Final = Path("/sys/devices/system/cpu/possible")
_STOPPED: Final = (errno.E2BIG, errno.ENOENT)
_NO_BATCH: Final = (errno.EINVAL, 524)  # ENOTSUPP: arrays, before Linux 5.13
_CHUNK: Final = 1 << 14  # entries per call: the kernel copies each one during the call


class MapKind(IntEnum):
    """``enum bpf_map_type``, as far as it is used here."""

    HASH = 1
    ARRAY = 2
    PERCPU_ARRAY = 6


@cache
def possible_cpus() -> int:
    """Return how many CPUs this kernel is prepared for, present or not."""
    ranges = (part.partition("-") for part in _POSSIBLE.read_text(encoding="ascii").strip().split(","))
    return sum(int(last or first) - int(first) + 1 for first, _, last in ranges)


class KernelMap:
    """One map.

    Args:
        kind: a hash starts empty and takes memory as it grows; an array is complete at once, and all zero.
        value_bytes: size of one value; for a per-CPU map, on one CPU.
        name: shown by diagnostic tools.
        is_mapped: of an array: it has ``words``.

    Attributes:
        value_bytes: bytes of one value as user space sees it: the values of all CPUs.
        words: of 64 bits, of all values; they follow what programs write.

    Raises:
        BpfError: the kernel refuses it.
    """

    def __init__(
        self, kind: MapKind, key_bytes: int, value_bytes: int, max_entries: int, name: str, *, is_mapped: bool = False
    ) -> None:
        self.max_entries = max_entries
        self.name = name
        each = -(-value_bytes // 8) * 8
        self.value_bytes = each * possible_cpus() if kind is MapKind.PERCPU_ARRAY else value_bytes
        flags = _NO_PREALLOC * (kind is MapKind.HASH) | _MAPPABLE * is_mapped
        shape = struct.pack("=5I", kind, key_bytes, value_bytes, max_entries, flags)
        attributes = bytearray(shape + struct.pack("=2I16s", 0, 0, name.encode()[:NAME_MAX]))
        self.fd = _create(attributes, f"make the map {name} of {max_entries} entries")
        self._key, self._value = bytearray(key_bytes), bytearray(self.value_bytes)
        self._one = bytearray(struct.pack("=IxxxxQQQ", self.fd, address(self._key), address(self._value), 0))
        self._one_key = self._one[:16]  # an operation without a value must get none
        self._tried = f"map {name}"
        mapped = mmap.mmap(self.fd, max_entries * self.value_bytes, access=mmap.ACCESS_READ) if is_mapped else b""
        self.words = memoryview(mapped).cast("Q")

    def close(self) -> None:
        """Close the descriptor; a program that uses the map keeps it."""
        if self.fd >= 0:
            self.words.release()
            os.close(self.fd)
            self.fd = -1

    def put(self, key: bytes, value: bytes) -> None:
        """Put or replace one entry. Raises ``BpfError``: E2BIG if the map is full."""
        self._key[:], self._value[:] = key, value
        bpf(Command.MAP_UPDATE_ELEM, self._one, self._tried)

    def get(self, key: bytes) -> bytes | None:
        """Return one entry's value, None if there is none. Safe in any thread."""
        given, value = bytearray(key), bytearray(self.value_bytes)
        try:
            attributes = bytearray(struct.pack("=IxxxxQQQ", self.fd, address(given), address(value), 0))
            bpf(Command.MAP_LOOKUP_ELEM, attributes, self._tried)
        except BpfError as error:
            if error.number == errno.ENOENT:
                return None
            raise
        return bytes(value)

    def remove(self, key: bytes) -> bool:
        """Remove one entry; return False if there was none."""
        self._key[:] = key
        try:
            bpf(Command.MAP_DELETE_ELEM, self._one_key, self._tried)
        except BpfError as error:
            if error.number == errno.ENOENT:
                return False
            raise
        return True

    def put_many(self, keys: Sequence[bytes], values: Sequence[bytes]) -> int:
        """Put entries in order until one is refused; return how many were put."""
        for at in range(0, len(keys), _CHUNK):
            some, theirs = keys[at : at + _CHUNK], values[at : at + _CHUNK]
            done = self._batch(Command.MAP_UPDATE_BATCH, b"".join(some), b"".join(theirs), len(some))
            while done < len(some):
                try:  # the batch refused one, or the kernel has no batches
                    self.put(some[done], theirs[done])
                except BpfError:
                    return at + done
                done += 1
        return len(keys)

    def remove_many(self, keys: Sequence[bytes]) -> None:
        """Remove entries; missing ones are ignored."""
        for at in range(0, len(keys), _CHUNK):
            some = keys[at : at + _CHUNK]
            for key in some[self._batch(Command.MAP_DELETE_BATCH, b"".join(some), b"", len(some)) :]:
                self.remove(key)

    def read_array(self, count: int) -> bytes:
        """Return the first ``count`` values of an array, concatenated. Safe in any thread."""
        if not count:
            return b""
        end, keys, values = bytearray(4), bytearray(4 * count), bytearray(self.value_bytes * count)
        places = address(end), address(keys), address(values)
        try:
            bpf(Command.MAP_LOOKUP_BATCH, bytearray(BATCH.pack(0, *places, count, self.fd, 0, 0)), self._tried)
        except BpfError as error:
            if error.number in _NO_BATCH:
                return b"".join(self.get(index.to_bytes(4, sys.byteorder)) or b"" for index in range(count))
            if error.number != errno.ENOENT:  # which marks the end of the array
                raise
        return bytes(values)

    def _batch(self, command: Command, keys: bytes, values: bytes, count: int) -> int:
        """Return how many were done, from the first on; the kernel reports it only if it refused one."""
        attributes = bytearray(BATCH.pack(0, 0, address(keys), address(values), count, self.fd, 0, 0))
        try:
            bpf(command, attributes, self._tried)
        except BpfError as error:
            return int(BATCH.unpack(attributes)[4]) if error.number in _STOPPED else 0
        return count


def _create(attributes: bytearray, tried: str) -> int:
    try:
        return bpf(Command.MAP_CREATE, attributes, tried)
    except BpfError as error:
        if error.number != errno.EPERM:
            raise
        try:  # before Linux 5.11, maps count as locked memory
            resource.setrlimit(resource.RLIMIT_MEMLOCK, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        except (OSError, ValueError):
            raise error from None
        return bpf(Command.MAP_CREATE, attributes, tried)
