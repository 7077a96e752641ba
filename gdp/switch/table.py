"""Forwarding table: the hops of each destination, under leases.

Sans-I/O; a data plane reads ``entries`` directly for every frame, and only the switch's core writes. Source:
docs/explanation/design.md, sections 6 and 7.

A key is a destination (32 bytes), or destination and source (64 bytes, in the order of the frame); the longer one is
looked up first. A value is the tuple of hops that each get a copy. The empty tuple is a negative entry: known to lead
nowhere. A hop may have an alternate, computed ahead (RFC 5286), which a data plane uses by itself while the first port
is down.

An entry may restrict the sides from which its frames come (reverse path forwarding, RFC 5110, section 1.2): a mask of
ports, for the trees of topics. A frame from another side is dropped, so that no node downstream of a publisher can
impersonate it.

Each hop of such an entry may have a pace: frames that state a higher one are for faster branches.

Leases are stored apart from the entries, so that the hot dictionary holds only what forwarding needs. A heap holds for
every entry at least one item that is no later than the end of its lease. Renewing a lease leaves the item unchanged; it
is corrected when it reaches the top. So no operation visits all entries, except a rebuild that as many changes have
paid for.

A data plane with its own copy receives every change before the call returns (``Observer``).
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Protocol

from gdp.errors import LocalError
from gdp.limits import PACE_MAX, TABLE_MAX
from gdp.names import NAME_BYTES

MACS_BYTES: Final = 12  # destination MAC, source MAC: the first bytes of the frame that goes out

Hop = tuple[int, bytes]  # port index, the 12 bytes of addresses
ProtectedHop = tuple[int, bytes, int, bytes]  # a hop, and its alternate
Hops = tuple[Hop | ProtectedHop, ...]
Paces = tuple[int, ...]  # of hops

NOWHERE: Final[Hops] = ()
EVERY_SIDE: Final = (1 << 64) - 1
SHARED_SIDE: Final = 63  # the bit of that port and all above

_KEY_SIZES: Final = (NAME_BYTES, 2 * NAME_BYTES)
EXPIRE_MAX: Final = 4_096
_SHARED_MAX: Final = 4_096  # hop tuples that are cached for sharing; a switch has far fewer different ones
_SLACK: Final = 1_024  # stale heap items that are not yet worth a rebuild


class Observer(Protocol):
    """A holder of a copy of the entries. It must not change the table, and cannot refuse a change."""

    def put(self, items: Mapping[bytes, Hops]) -> None:
        """Add entries that are new, or whose hops changed; a renewed lease alone is no change."""

    def remove(self, keys: Sequence[bytes]) -> None:
        """Remove entries."""


class Table:
    """Entries under leases.

    Args:
        max_entries: most entries that may stand at once.

    Attributes:
        entries: key to hops. Data planes hold this very dictionary; it is never replaced.
        sides: key to the mask of ports that frames may come from; what is not in it may come from everywhere.
        paces: key to the pace of each hop, in order; hops of what is not in it get every frame.
    """

    __slots__ = ("_ends", "_heap", "_max", "_observer", "_shared", "entries", "paces", "sides")

    def __init__(self, max_entries: int = TABLE_MAX) -> None:
        self.entries: dict[bytes, Hops] = {}
        self.sides: dict[bytes, int] = {}
        self.paces: dict[bytes, Paces] = {}
        self._ends: dict[bytes, float] = {}
        self._heap: list[tuple[float, bytes]] = []
        self._shared: dict[Hops, Hops] = {}
        self._max = max_entries
        self._observer: Observer | None = None

    def __len__(self) -> int:
        return len(self.entries)

    def end_of(self, key: bytes) -> float | None:
        """Return the monotonic second at which the lease of an entry ends, or None."""
        return self._ends.get(key)

    def observe(self, observer: Observer | None) -> None:
        """Send one observer all present entries, and from now on each change; None: no observer."""
        self._observer = observer
        if observer is not None and self.entries:
            observer.put(self.entries)

    def install(self, key: bytes, hops: Hops, expires_s: float, sides: int = EVERY_SIDE, paces: Paces = ()) -> bool:
        """Add or replace an entry and its lease; False when the table is full and the key is new.

        Args:
            key: 32 bytes (destination) or 64 (destination, source).
            hops: where copies go; equal tuples are shared in memory. ``NOWHERE`` makes a negative entry.
            expires_s: end of the lease, on the monotonic clock of the caller.
            sides: mask of ports that frames may come from, as ``sides_of`` makes it.
            paces: of the hops, in order; empty: each gets every frame.

        Raises:
            LocalError: a key or an address of another length.
        """
        _check(key, hops)
        known = self._ends.get(key)
        if known is None:
            if len(self.entries) >= self._max:
                return False
            key = bytes(key)  # plain bytes: looked up faster than a subclass
        hops = self._share(hops)
        if all(pace == PACE_MAX for pace in paces):
            paces = ()
        before = self.entries.get(key), self.sides.get(key, EVERY_SIDE), self.paces.get(key, ())
        is_news = before != (hops, sides, paces)
        self.entries[key] = hops
        if sides != EVERY_SIDE:
            self.sides[bytes(key)] = sides
        else:
            self.sides.pop(key, None)
        if paces:
            self.paces[bytes(key)] = paces
        else:
            self.paces.pop(key, None)
        self._ends[key] = expires_s
        if known is None or expires_s < known:
            heapq.heappush(self._heap, (expires_s, key))
            self._rebuild_if_stale()
        if self._observer is not None and is_news:
            self._observer.put({key: hops})
        return True

    def remove(self, key: bytes) -> bool:
        """Remove an entry; False when there was none."""
        if self.entries.pop(key, None) is None:
            return False
        del self._ends[key]
        self.sides.pop(key, None)
        self.paces.pop(key, None)
        self._rebuild_if_stale()
        if self._observer is not None:
            self._observer.remove((key,))
        return True

    def expire(self, now_s: float) -> list[bytes]:
        """Remove entries whose lease ended at or before ``now_s``, earliest first; return their keys.

        At most ``EXPIRE_MAX`` are removed at once, so that a node is not busy with them for long; while more are due,
        ``next_expiry`` returns a past time.
        """
        gone: list[bytes] = []
        while len(gone) < EXPIRE_MAX and self._settle() and self._heap[0][0] <= now_s:
            key = heapq.heappop(self._heap)[1]
            del self._ends[key]
            del self.entries[key]
            self.sides.pop(key, None)
            self.paces.pop(key, None)
            gone.append(key)
        if self._observer is not None and gone:
            self._observer.remove(gone)
        return gone

    def next_expiry(self) -> float | None:
        """Return when the first lease ends, or None for an empty table."""
        return self._heap[0][0] if self._settle() else None

    def _settle(self) -> bool:
        """Move a valid lease end to the top of the heap; False when there is none."""
        heap, ends = self._heap, self._ends
        while heap:
            end, key = heap[0]
            true_end = ends.get(key)
            if true_end is None:
                heapq.heappop(heap)
            elif true_end > end:
                heapq.heapreplace(heap, (true_end, key))
            else:
                return True
        return False

    def _share(self, hops: Hops) -> Hops:
        """Return the one cached tuple that equals ``hops``."""
        if len(self._shared) >= _SHARED_MAX:
            self._shared.clear()  # only sharing is lost
        return self._shared.setdefault(hops, hops)

    def _rebuild_if_stale(self) -> None:
        if len(self._heap) > 2 * len(self.entries) + _SLACK:
            self._heap = [(end, key) for key, end in self._ends.items()]
            heapq.heapify(self._heap)


def sides_of(ports: Iterable[int]) -> int:
    """Return the mask of ports; those from the 63rd on share one bit."""
    mask = 0
    for port in ports:
        mask |= 1 << min(port, SHARED_SIDE)
    return mask


def is_side(mask: int, port: int) -> bool:
    """Return whether a port is in a mask."""
    return bool(mask >> min(port, SHARED_SIDE) & 1)


def _check(key: bytes, hops: Hops) -> None:
    if len(key) not in _KEY_SIZES:
        raise LocalError(f"a table key has {NAME_BYTES} or {2 * NAME_BYTES} bytes, not {len(key)}")
    if any(len(hop[1]) != MACS_BYTES or (len(hop) > 2 and len(hop[3]) != MACS_BYTES) for hop in hops):
        raise LocalError(f"a hop has {MACS_BYTES} bytes of addresses: destination MAC, source MAC")
