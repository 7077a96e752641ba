"""Revocations of owners that this switch's operator handed in: the RIB is told them, again and again.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A RIB keeps one only while a name that it concerns is stored
or watched there, and acknowledges none. So each is said three times at first, then once a while: who begins to use the
name later meets it.
"""

from __future__ import annotations

import heapq
from typing import Final

__all__ = ["HandedIn"]

_FIRST_S: Final = (0.3, 1.0, 3.0)  # from the first time to the next ones
_AGAIN_S: Final = 60.0
_TICK_S: Final = 0.1
_PER_TICK: Final = 4


class HandedIn:
    """Statements by fingerprint, and when each is due next."""

    def __init__(self) -> None:
        self._wires: dict[bytes, bytes] = {}
        self._due: list[tuple[float, int, bytes]] = []  # when, how often it was said, fingerprint
        self._tick_at_s = float("-inf")

    def add(self, fingerprint: bytes, wire: bytes, now_s: float) -> None:
        """Have a statement said from now on."""
        if fingerprint not in self._wires:
            heapq.heappush(self._due, (now_s, 0, fingerprint))
        self._wires[fingerprint] = wire

    def remove(self, fingerprint: bytes) -> None:
        """Say one no more: it has run out."""
        self._wires.pop(fingerprint, None)

    def say_again(self, now_s: float) -> None:
        """Have everything said anew: there is another RIB."""
        self._due = [(now_s, 0, fingerprint) for fingerprint in self._wires]

    def due(self, now_s: float) -> list[tuple[bytes, bytes]]:
        """Return the few statements to say now, each with its fingerprint."""
        if now_s < self._tick_at_s:
            return []
        said: list[tuple[bytes, bytes]] = []
        while self._due and self._due[0][0] <= now_s and len(said) < _PER_TICK:
            _, times, fingerprint = heapq.heappop(self._due)
            wire = self._wires.get(fingerprint)
            if wire is not None:
                said.append((fingerprint, wire))
                pause_s = _FIRST_S[times] if times < len(_FIRST_S) else _AGAIN_S
                heapq.heappush(self._due, (now_s + pause_s, times + 1, fingerprint))
        if said:
            self._tick_at_s = now_s + _TICK_S
        return said

    def next_due(self) -> float | None:
        """Return the monotonic second of the next statement, or None."""
        return max(self._due[0][0], self._tick_at_s) if self._due else None
