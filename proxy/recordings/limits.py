"""Limits of the process that decodes a recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

_MEMORY_BYTES: Final = 1 << 30
_MEMORY_PER_BYTE: Final = 8  # an index entry of 31 bytes takes about 200 in memory
_MEMORY_MOST_BYTES: Final = 4 << 30
_CPU_S: Final = 30.0
_CPU_S_PER_BYTE: Final = 2.0 / (1 << 20)  # bz2 takes a fifteenth of that
_WAIT_S: Final = 60.0
_WAIT_PER_CPU: Final = 2.0


@dataclass(frozen=True, slots=True)
class BagLimits:
    """Limits for one recording.

    Args:
        memory_bytes: address space of the process; None: 1 GiB and eight times the recording's bytes, at most 4 GiB.
        cpu_s: processor time of the process; None: 30 s, and 2 s for each MiB of the recording.
    """

    memory_bytes: int | None = None
    cpu_s: float | None = None

    def memory_for(self, size: int) -> int:
        """Return the bytes of address space for a recording of ``size`` bytes."""
        if self.memory_bytes is not None:
            return self.memory_bytes
        return min(_MEMORY_BYTES + _MEMORY_PER_BYTE * size, _MEMORY_MOST_BYTES)

    def cpu_s_for(self, size: int) -> float:
        """Return the seconds of processor time for a recording of ``size`` bytes."""
        return _CPU_S + _CPU_S_PER_BYTE * size if self.cpu_s is None else self.cpu_s

    def wait_s_for(self, size: int) -> float:
        """Return the seconds for which the process may send nothing while the caller waits."""
        return max(_WAIT_S, _WAIT_PER_CPU * self.cpu_s_for(size))
