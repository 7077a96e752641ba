"""Program loaded into the kernel, with its maps, which a plane writes and whose counters it reads.

I/O. Nothing is pinned: the program and maps last as long as their descriptors and attachments. Each port has a program
of its own, because an entry states which ports its frames may come from.
"""

from __future__ import annotations

import os
import sys
import time
from typing import Final

from gdp.errors import DROP_COUNTERS, LocalError
from gdp.ports.kernel import abi
from gdp.ports.kernel.abi import (
    COUNT_BYTES,
    ENTRY_BYTES,
    GROUP_BYTES,
    GROUPS_MAX,
    INDEX_BYTES,
    KEY_BYTES,
    PORT_BYTES,
    PORTS_MAX,
    TOTALS_BYTES,
    Total,
)
from gdp.ports.kernel.maps import KernelMap, MapKind, possible_cpus
from gdp.ports.kernel.program import LICENCE, Descriptors, forwarder
from gdp.ports.kernel.syscall import load_program
from gdp.ports.plane import Counters
from gdp.switch.table import SHARED_SIDE

PROGRAM: Final = "gdp_forward"
_FIRST: Final = bytes(INDEX_BYTES)


class LoadedProgram:
    """One program and its maps.

    Args:
        entries_max: most entries that the kernel holds. Each may cost 16 bytes on every CPU and 16 bytes of a hash
            bucket at once, and about 130 bytes once it exists.
        leased: whether forwarding needs ``renew``; for a program that outlives its process.

    Raises:
        LocalError: the process lacks the right, the kernel is too old, or the machine is unknown.
        LoadRefusedError: with the verifier's log.
    """

    def __init__(self, entries_max: int, *, leased: bool = False) -> None:
        self._maps: list[KernelMap] = []
        self._programs: dict[int, int] = {}  # descriptors, by port
        self._last = Counters()
        try:
            self.entries = self._make(MapKind.HASH, KEY_BYTES, ENTRY_BYTES, entries_max, "gdp_entries")
            self.ports = self._make(MapKind.ARRAY, INDEX_BYTES, PORT_BYTES, PORTS_MAX, "gdp_ports")
            self.groups = self._make(MapKind.HASH, INDEX_BYTES, GROUP_BYTES, GROUPS_MAX, "gdp_groups")
            self.totals = self._make(MapKind.PERCPU_ARRAY, INDEX_BYTES, TOTALS_BYTES, 1, "gdp_totals")
            self.counts = self._make(MapKind.PERCPU_ARRAY, INDEX_BYTES, COUNT_BYTES, entries_max + 1, "gdp_counts")
            self._lease = self._make(MapKind.ARRAY, INDEX_BYTES, 8, 1, "gdp_lease") if leased else None
            self._descriptors = Descriptors(
                entries=self.entries.fd,
                ports=self.ports.fd,
                groups=self.groups.fd,
                totals=self.totals.fd,
                counts=self.counts.fd,
                lease=None if self._lease is None else self._lease.fd,
            )
            self.program_of(0)
        except LocalError:
            self.close()
            raise

    def program_of(self, port: int) -> int:
        """Return the descriptor of the program for the ingress of a port.

        Raises:
            LoadRefusedError: with the verifier's log.
        """
        side = min(port, SHARED_SIDE)
        if side not in self._programs:
            self._programs[side] = load_program(forwarder(self._descriptors, side), PROGRAM, LICENCE)
        return self._programs[side]

    @property
    def is_leased(self) -> bool:
        """Return whether the program forwards only while its lease is renewed."""
        return self._lease is not None

    @property
    def of_entries(self) -> tuple[KernelMap, KernelMap, KernelMap]:
        """The maps of entries, groups and counts, which a ``MapSync`` writes."""
        return self.entries, self.groups, self.counts

    def close(self) -> None:
        """Close all descriptors; an attached program keeps what it needs."""
        if self._programs:
            self._last = self.counters()
        for program in self._programs.values():
            os.close(program)
        self._programs.clear()
        for each in self._maps:
            each.close()

    def renew(self, valid_s: float) -> None:
        """Let a leased program forward for this long from now."""
        if self._lease is not None:
            until_ns = time.monotonic_ns() + int(valid_s * 1e9)
            self._lease.put(_FIRST, until_ns.to_bytes(8, sys.byteorder))

    def set_port(self, index: int, ifindex: int, mtu: int, flags: int) -> None:
        """Set the state of a port; ``ifindex`` 0 means down."""
        if index < PORTS_MAX:
            self.ports.put(index.to_bytes(INDEX_BYTES, sys.byteorder), abi.port(ifindex, mtu, flags))

    def counters(self) -> Counters:
        """Return the counts of the program up to its release. Safe in any thread."""
        if not self._programs:
            return self._last
        words, width = self._words()
        totals = [sum(words[at::width]) for at in range(width)]
        copies = totals[Total.COPIES]
        return Counters(totals[Total.TAKEN], copies, copies, 0, totals[:DROP_COUNTERS])

    def frames_from(self, port: int) -> int:
        """Return how many frames the program has taken from a port; 0 for a port that shares its side with others."""
        if not self._programs or port >= SHARED_SIDE:
            return 0
        words, width = self._words()
        return sum(words[Total.FROM + port :: width])

    def _words(self) -> tuple[memoryview[int], int]:
        """Return the counters of all CPUs, and how many each has."""
        words = memoryview(self.totals.get(_FIRST) or b"").cast("Q")
        return words, len(words) // possible_cpus()

    def _make(self, kind: MapKind, key_bytes: int, value_bytes: int, max_entries: int, name: str) -> KernelMap:
        made = KernelMap(kind, key_bytes, value_bytes, max_entries, name)
        self._maps.append(made)
        return made
