"""How many second copies requests may have.

Place: pure.
Source: Dean and Barroso, "The Tail at Scale", CACM 56(2), 2013: a few percent of hedged requests take the tail away.
"""

from __future__ import annotations

from typing import Final

__all__ = ["HedgeBudget"]

SAVED_MAX: Final = 10.0  # second copies that quiet times leave for a burst


class HedgeBudget:
    """Earned by requests, spent by second copies.

    Args:
        share: second copies per request, 0 to 1.
    """

    __slots__ = ("_saved", "_share")

    def __init__(self, share: float) -> None:
        self._share = share
        self._saved = 0.0

    def earn(self) -> None:
        """Note a request."""
        self._saved = min(self._saved + self._share, SAVED_MAX)

    def spend(self) -> bool:
        """Return whether a second copy may go; that counts as one."""
        if self._saved < 1 - 1e-9:  # fifty shares of 0.02 are one
            return False
        self._saved -= 1
        return True
