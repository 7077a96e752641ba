"""Shares: division of a bounded capacity among its owners, so that no owner exhausts it.

Sans-I/O. Source: dynamic thresholds, A. Choudhury and E. Hahne, IEEE/ACM Transactions on Networking 6(2), 1998. An
owner may hold at most as much as is free. One owner alone gets half of the capacity, n greedy ones 1/(n+1) each. As
much as one of them holds stays free for the next one, and no owner loses what it holds.
"""

from __future__ import annotations


class Shares:
    """Shares of a capacity, by owner."""

    __slots__ = ("_held", "_of", "_size")

    def __init__(self, size: int) -> None:
        self._size = size
        self._held = 0
        self._of: dict[bytes, int] = {}

    def __len__(self) -> int:
        return self._held

    def held_by(self, owner: bytes) -> int:
        """Return what an owner holds."""
        return self._of.get(owner, 0)

    def reserve(self, *owners: bytes, size: int = 1) -> bool:
        """Reserve capacity in the name of all these owners (a participant and its domain, say) and return True.

        Returns False, and reserves none, if one of them would hold more than is left free.
        """
        free = self._size - self._held - size
        if free < 0 or any(self.held_by(owner) + size > free + size for owner in owners):
            return False
        self._held += size
        for owner in owners:
            self._of[owner] = self.held_by(owner) + size
        return True

    def release(self, *owners: bytes, size: int = 1) -> None:
        """Release what was reserved in the name of the same owners."""
        self._held -= size
        for owner in owners:
            left = self._of[owner] - size
            if left:
                self._of[owner] = left
            else:
                del self._of[owner]
