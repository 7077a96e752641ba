"""Map synchronisation: the kernel's map equals the forwarding table before the table's call returns.

I/O; an ``Observer`` of ``gdp.switch.table.Table``.
The map leaves out what the kernel cannot hold: a full map, more than 64 branches, a port number out of range. Those
frames are punted, and Python forwards them with the table itself. Therefore nothing here fails; ``left_out`` counts
those entries.

An entry names its counter, so replacing an entry keeps its counts. Entries with equal branches share one group. A group
never changes while an entry names it. Free numbers are reused as late as possible, because a frame in progress may
still use them.
"""

from __future__ import annotations

import errno
import heapq
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final

from gdp.limits import PACE_MAX
from gdp.names import NAME_BYTES
from gdp.ports.kernel.abi import (
    BRANCHES_MAX,
    EVERY_SOURCE,
    GROUP,
    INDEX_BYTES,
    NOWHERE_PORT,
    PORTS_MAX,
    entry_head,
    entry_tail,
    group,
)
from gdp.ports.kernel.maps import KernelMap
from gdp.ports.kernel.syscall import BpfError
from gdp.switch.table import EVERY_SIDE, Hops, Paces, Table

EntryCounts = dict[bytes, tuple[int, int]]  # by the table's key: frames, and their bytes

_GROUP_FROM: Final = 2  # branches
_UNCOUNTED: Final = 0  # counter shared by all entries without one of their own


@dataclass(slots=True)
class _Group:
    number: int
    branches: tuple[Hops, Paces]
    users: int = 0


def _index(number: int) -> bytes:
    return number.to_bytes(INDEX_BYTES, sys.byteorder)


def _kernel_key(key: bytes) -> bytes:
    return key if len(key) > NAME_BYTES else key + EVERY_SOURCE


class MapSync:
    """The table as the kernel sees it.

    Args:
        table: the table to copy; it is only read.
        entries: hash of entries.
        groups: hash of groups, by number.
        counts: per-CPU array of counters, one more than the maximum number of entries.
    """

    def __init__(self, table: Table | None, entries: KernelMap, groups: KernelMap, counts: KernelMap) -> None:
        self._table: Mapping[bytes, Hops] = {} if table is None else table.entries
        self._sides: Mapping[bytes, int] = {} if table is None else table.sides
        self._paces: Mapping[bytes, Paces] = {} if table is None else table.paces
        self._entries, self._groups, self._counts = entries, groups, counts
        self._counter_of: dict[bytes, int] = {}  # by the table's key: entries in the kernel
        self._key_of: list[bytes] = [b""]  # by counter
        self._free_counters: deque[int] = deque()
        self._group_of: dict[bytes, _Group] = {}  # by key, of the entries that have a group
        self._group_by: dict[tuple[Hops, Paces], _Group] = {}
        self._free_groups: deque[int] = deque(range(groups.max_entries))
        self._waiting: dict[bytes, None] = {}  # entries that wait for space in the map
        self._unfit: set[bytes] = set()
        self._zero_sources: set[bytes] = set()  # destinations that have an entry for the source zero

    def __len__(self) -> int:
        return len(self._counter_of)

    @property
    def left_out(self) -> int:
        """Number of the table's entries that only Python knows."""
        return len(self._waiting) + len(self._unfit)

    def put(self, items: Mapping[bytes, Hops]) -> None:
        """Write entries of the table to the kernel's maps; an entry that does not fit stays in Python alone."""
        keys: list[bytes] = []
        kernel_keys: list[bytes] = []
        values: list[bytes] = []
        left: list[_Group] = []
        used: list[int] = []
        fresh: set[bytes] = set()  # keys that the kernel did not have
        headers: dict[int, bytes] = {}  # by identity, because the table shares equal hops; without groups
        counter_of, group_of, sides = self._counter_of, self._group_of, self._sides
        for key, hops in items.items():
            if group_of and key in group_of:
                left.append(group_of.pop(key))
            head = None if key in self._paces else headers.get(id(hops))
            if head is None:
                head = self._head(key, hops)
                if len(hops) < _GROUP_FROM and key not in self._paces:
                    headers[id(hops)] = head
            if self._is_ambiguous(key) or not head:
                self._leave_out(key)
                continue
            counter = counter_of.get(key)
            if counter is None:
                counter = counter_of[key] = self._new_counter(key, used)
                fresh.add(key)
            keys.append(key)
            # ``_kernel_key`` and ``_index`` inlined: a table may hold a hundred thousand names
            kernel_keys.append(key if len(key) > NAME_BYTES else key + EVERY_SOURCE)
            values.append(head + entry_tail(counter, sides.get(key, EVERY_SIDE)))
        self._counts.put_many([*map(_index, used)], [bytes(self._counts.value_bytes)] * len(used))
        self._write(keys, kernel_keys, values, fresh)
        for name in self._zero_sources:  # empty, unless a peer misbehaves
            if name in counter_of:
                self._leave_out(name)
        for each in left:
            self._leave_group(each)

    def remove(self, keys: Sequence[bytes]) -> None:
        """Remove entries from the kernel's maps; keys that are not there are ignored."""
        gone: list[bytes] = []
        for key in keys:
            if key in self._counter_of:
                gone.append(key)
            self._waiting.pop(key, None)
            self._unfit.discard(key)
        self._remove_entries(gone)
        if self._zero_sources:
            freed = {key[:NAME_BYTES] for key in keys if len(key) > NAME_BYTES} & self._zero_sources
            freed = {name for name in freed if name + EVERY_SOURCE not in self._table}
            self._zero_sources -= freed
            self._put_again([*freed])
        self._put_again(list(islice(self._waiting, len(gone))))

    def counts(self, most: int) -> EntryCounts:
        """Return the ``most`` entries that forwarded most frames. Safe in any thread."""
        keys = self._key_of[:]
        words = memoryview(self._counts.read_array(len(keys))).cast("Q")
        width = self._counts.value_bytes // words.itemsize
        frames = [sum(each) for each in zip(*(words[at::width] for at in range(0, width, 2)), strict=True)]
        top = heapq.nlargest(most, (n for n in range(1, len(keys)) if frames[n]), key=frames.__getitem__)
        found = {keys[n]: (frames[n], sum(words[n * width + 1 : (n + 1) * width : 2])) for n in top}
        found.pop(b"", None)
        return found

    # entries

    def _write(self, keys: list[bytes], kernel_keys: list[bytes], values: list[bytes], fresh: set[bytes]) -> None:
        """Write entries to the kernel; those that do not fit wait."""
        is_full = False
        at = self._entries.put_many(kernel_keys, values)
        if self._waiting or self._unfit:
            for key in keys[:at]:
                self._waiting.pop(key, None)
                self._unfit.discard(key)
        for key, kernel_key, value in zip(keys[at:], kernel_keys[at:], values[at:], strict=True):
            if is_full and key in fresh:
                self._give_back([key])
                self._wait(key)
                continue
            try:  # an entry that replaces another still fits
                self._entries.put(kernel_key, value)
            except BpfError as error:
                is_full = is_full or error.number == errno.E2BIG
                self._remove_entries([key])  # an older entry there would be wrong now
                self._wait(key)

    def _wait(self, key: bytes) -> None:
        self._unfit.discard(key)
        self._waiting[key] = None

    def _remove_entries(self, keys: Sequence[bytes]) -> None:
        """Remove entries from the kernel, then free the counters and groups that they used."""
        self._entries.remove_many([*map(_kernel_key, keys)])
        self._give_back(keys)

    def _give_back(self, keys: Sequence[bytes]) -> None:
        for key in keys:
            counter = self._counter_of.pop(key, _UNCOUNTED)
            if counter != _UNCOUNTED:
                self._key_of[counter] = b""
                self._free_counters.append(counter)
            left = self._group_of.pop(key, None)
            if left is not None:
                self._leave_group(left)

    def _leave_out(self, key: bytes) -> None:
        self._remove_entries([key])
        self._waiting.pop(key, None)
        self._unfit.add(key)

    def _put_again(self, keys: Sequence[bytes]) -> None:
        again = {key: self._table[key] for key in keys if key in self._table}
        if again:
            self.put(again)

    def _is_ambiguous(self, key: bytes) -> bool:
        """Return whether the kernel cannot tell an entry for every source from one for the source zero."""
        if len(key) == NAME_BYTES:
            return key in self._zero_sources
        if not key.endswith(EVERY_SOURCE):
            return False
        self._zero_sources.add(key[:NAME_BYTES])
        return True

    def _new_counter(self, key: bytes, used: list[int]) -> int:
        """Return a counter that is zero or is cleared later: ``used`` are those to clear."""
        if len(self._key_of) < self._counts.max_entries:
            self._key_of.append(key)
            return len(self._key_of) - 1
        if not self._free_counters:
            return _UNCOUNTED
        counter = self._free_counters.popleft()
        self._key_of[counter] = key
        used.append(counter)
        return counter

    # heads of entries

    def _head(self, key: bytes, hops: Hops) -> bytes:
        """Return the beginning of an entry; empty if the kernel cannot forward by it."""
        if len(hops) > BRANCHES_MAX or any(port >= PORTS_MAX for hop in hops for port in hop[::2]):
            return b""
        if len(hops) >= _GROUP_FROM:
            return self._join_group(key, hops)
        paces = self._paces.get(key, (PACE_MAX,))
        return entry_head(*hops[0], group=paces[0]) if hops else entry_head(NOWHERE_PORT)

    def _join_group(self, key: bytes, hops: Hops) -> bytes:
        branches = hops, self._paces.get(key, ())
        known = self._group_by.get(branches)
        if known is None:
            if not self._free_groups:
                return b""
            known = _Group(self._free_groups.popleft(), branches)
            try:
                self._groups.put(_index(known.number), group(*branches))
            except BpfError:
                self._free_groups.append(known.number)
                return b""
            self._group_by[branches] = known
        known.users += 1
        self._group_of[key] = known
        return entry_head(GROUP, group=known.number)

    def _leave_group(self, left: _Group) -> None:
        left.users -= 1
        if not left.users:
            del self._group_by[left.branches]
            self._groups.remove(_index(left.number))
            self._free_groups.append(left.number)
