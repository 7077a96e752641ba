"""Replicated log of one service: its entries, and the state that stands for those that were removed.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from gdp.service.replication_messages import Snapshot

__all__ = ["ReplicatedLog"]

ENTRIES_MAX: Final = 65_536
LOG_MAX_BYTES: Final = 64 << 20
STATE_EVERY: Final = 1_024  # entries after which another state is wanted
STATE_EVERY_BYTES: Final = 4 << 20


class ReplicatedLog:
    """Requests in their order, from 1, without a gap; the oldest are forgotten when a state stands for them.

    Attributes:
        last: the newest.
        state: the newest known; None: the log begins where it began.
    """

    def __init__(
        self, *, entries_max: int = ENTRIES_MAX, max_bytes: int = LOG_MAX_BYTES, state_every: int = STATE_EVERY
    ) -> None:
        self._entries_max = entries_max
        self._max_bytes = max_bytes
        self._state_every = state_every
        self._requests: dict[int, bytes] = {}
        self._bytes = 0
        self._bytes_after_state = 0
        self.last = 0
        self.state: Snapshot | None = None

    def __len__(self) -> int:
        return len(self._requests)

    def __contains__(self, index: int) -> bool:
        return index in self._requests

    def __getitem__(self, index: int) -> bytes:
        return self._requests[index]

    @property
    def forgotten(self) -> int:
        """Return the newest entry that is not there any more; 0: all are."""
        return self.last - len(self._requests)

    @property
    def is_full(self) -> bool:
        """Return whether no more may come."""
        return len(self._requests) >= self._entries_max or self._bytes >= self._max_bytes

    @property
    def wants_state(self) -> bool:
        """Return whether it is time for a state, the first or another."""
        after = self.last - (self.state.at if self.state is not None else 0)
        return self.state is None or after >= self._state_every or self._bytes_after_state >= STATE_EVERY_BYTES

    def append(self, request: bytes) -> None:
        """Take the next entry."""
        self.last += 1
        self._requests[self.last] = request
        self._bytes += len(request)
        self._bytes_after_state += len(request)

    def learn(self, state: Snapshot) -> None:
        """Take a state, if it is newer."""
        if self.state is None or state.at > self.state.at:
            self.state = state
            newer = range(max(state.at, self.forgotten) + 1, self.last + 1)
            self._bytes_after_state = sum(len(self._requests[index]) for index in newer)

    def trim(self, done: Iterable[int]) -> None:
        """Forget what the state stands for; what a replica still lacks stays while there is room.

        Args:
            done: the last entry that each replica has done.
        """
        if self.state is None:
            return
        is_tight = len(self._requests) > self._entries_max // 2 or self._bytes > self._max_bytes // 2
        until = self.state.at if is_tight else min([self.state.at, *done])
        for index in range(self.forgotten + 1, until + 1):
            self._bytes -= len(self._requests.pop(index))
