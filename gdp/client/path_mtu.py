"""Path MTU of a tree at its publisher: follows the joins, as long as that does not cost too much.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Cached messages are sealed again when the path becomes too
narrow for them: at most ``MTU_NARROWINGS`` times, and once more every ``MTU_HOLD_S``. Until then wider values are
ignored, and the MTU falls from plateau to plateau (RFC 1191, section 7.1), of which there are few.
"""

from __future__ import annotations

from typing import Final

from gdp.limits import FRAME_MAX_BYTES, MTU_HOLD_S, MTU_MIN_BYTES, MTU_NARROWINGS

PLATEAUS: Final = (FRAME_MAX_BYTES, 32_000, 17_914, 8_166, 4_352, 2_002, 1_492, 1_006, MTU_MIN_BYTES)


class PathMtu:
    """MTU of one tree, in bytes after the Ethernet header."""

    def __init__(self) -> None:
        self._mtu: int | None = None
        self._narrowings = float(MTU_NARROWINGS)  # narrowings that may still cause a new seal
        self._counted_s = 0.0

    def receive_mtu(self, mtu: int, now_s: float) -> int:
        """Process the MTU of a join; return the MTU that is valid now."""
        more = max(now_s - self._counted_s, 0.0) / MTU_HOLD_S
        self._narrowings, self._counted_s = min(self._narrowings + more, MTU_NARROWINGS), now_s
        may_narrow = self._narrowings >= 1
        if self._mtu is not None and mtu < self._mtu:
            self._mtu = mtu if may_narrow else next((each for each in PLATEAUS if each <= mtu), mtu)
        elif self._mtu is None or may_narrow:
            self._mtu = mtu
        return self._mtu

    def count(self) -> None:
        """Note that something had to be sealed again."""
        self._narrowings = max(self._narrowings - 1, 0.0)
