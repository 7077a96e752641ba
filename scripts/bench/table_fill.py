"""Bulk fill of a large forwarding table: speed and memory.

I/O. Queries the kernel about this process. Memory of an eBPF map is no part of a process's resident memory; the
kernel reports it with the map's file descriptor (``memlock``, proc(5)).
"""

from __future__ import annotations

import gc
import time
from itertools import islice
from typing import Final

from frames import table_key
from machine import map_bytes, resident_bytes

from gdp.switch.table import Hops, Table

__all__ = ["ENTRY_LEASE_S", "fill"]

ENTRY_LEASE_S: Final = 1e9
_CHUNK: Final = 100_000  # entries a call; made outside the measured time


def fill(table: Table, names: int, hops: Hops) -> dict[str, float]:
    """Put the first ``names`` entries in, then all of them again, as renewed leases do."""
    gc.collect()
    resident = resident_bytes()
    first_s, placed = _pass(table, names, hops)
    gc.collect()
    grown, mapped = resident_bytes() - resident, map_bytes()
    again_s, _ = _pass(table, names, hops)
    return {
        "placed": placed,
        "resident_bytes": grown,
        "map_bytes": mapped,
        "installs_per_s": names / first_s,
        "renewals_per_s": names / again_s,
    }


def _pass(table: Table, names: int, hops: Hops) -> tuple[float, int]:
    keys, spent_s, placed = map(table_key, range(names)), 0.0, 0
    while chunk := [(key, hops) for key in islice(keys, _CHUNK)]:
        begun_s = time.perf_counter()
        placed += table.install_many(chunk, ENTRY_LEASE_S)
        spent_s += time.perf_counter() - begun_s
    return spent_s, placed
