"""Hedge budget: how many second copies requests may have.

Sans-I/O. Source: Dean and Barroso, "The Tail at Scale", CACM 56(2), 2013: a few percent of hedged requests remove the
tail.
"""

from __future__ import annotations

from typing import Final

SAVED_MAX: Final = 10.0  # second copies that quiet times save for a burst


class HedgeBudget:
    """Budget that requests earn and second copies spend; ``share``: second copies per request, 0 to 1."""

    __slots__ = ("_saved", "_share")

    def __init__(self, share: float) -> None:
        self._share = share
        self._saved = 0.0

    def earn(self) -> None:
        """Record a request."""
        self._saved = min(self._saved + self._share, SAVED_MAX)

    def spend(self) -> bool:
        """Return whether a second copy may be sent; that spends one."""
        if self._saved < 1 - 1e-9:  # fifty shares of 0.02 are one
            return False
        self._saved -= 1
        return True
