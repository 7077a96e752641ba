"""Replicated log of one service: its entries, and the snapshot that replaces those that were removed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from gdp.service.replication_messages import Snapshot

ENTRIES_MAX: Final = 65_536
LOG_MAX_BYTES: Final = 64 << 20
STATE_EVERY: Final = 1_024  # entries after which another snapshot is due
STATE_EVERY_BYTES: Final = 4 << 20


class ReplicatedLog:
    """Requests in their order, from 1, without a gap; a snapshot replaces the oldest.

    Attributes:
        last: the newest.
        state: the newest snapshot; None: none yet.
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
        """Return the newest entry that was removed; 0: none was."""
        return self.last - len(self._requests)

    @property
    def is_full(self) -> bool:
        """Return whether the log is full."""
        return len(self._requests) >= self._entries_max or self._bytes >= self._max_bytes

    @property
    def wants_state(self) -> bool:
        """Return whether a snapshot is due, the first or another."""
        after = self.last - (self.state.at if self.state is not None else 0)
        return self.state is None or after >= self._state_every or self._bytes_after_state >= STATE_EVERY_BYTES

    def append(self, request: bytes) -> None:
        """Append the next entry."""
        self.last += 1
        self._requests[self.last] = request
        self._bytes += len(request)
        self._bytes_after_state += len(request)

    def restore_snapshot(self, state: Snapshot) -> None:
        """Store a snapshot, if it is newer."""
        if self.state is None or state.at > self.state.at:
            self.state = state
            newer = range(max(state.at, self.forgotten) + 1, self.last + 1)
            self._bytes_after_state = sum(len(self._requests[index]) for index in newer)

    def trim(self, done: Iterable[int]) -> None:
        """Remove entries that the snapshot replaces; those that a replica lacks stay while the log has space.

        Args:
            done: the last entry that each replica has applied.
        """
        if self.state is None:
            return
        is_tight = len(self._requests) > self._entries_max // 2 or self._bytes > self._max_bytes // 2
        until = self.state.at if is_tight else min([self.state.at, *done])
        for index in range(self.forgotten + 1, until + 1):
            self._bytes -= len(self._requests.pop(index))
