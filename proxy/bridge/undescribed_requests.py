"""Messages of clients that are not described yet: they wait, in a room where no client takes the others' share.

Place: pure.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import Final

from gdp.client.participant import Message

__all__ = ["UndescribedRequests"]

EARLY_MAX: Final = 256  # of one client
EARLY_MAX_BYTES: Final = 64 << 20  # of all; a client may have as much as it leaves free for others


class UndescribedRequests:
    """What waits, by client and in its order."""

    def __init__(self, max_bytes: int = EARLY_MAX_BYTES) -> None:
        self._waiting: dict[bytes, deque[Message]] = {}
        self._bytes: dict[bytes, int] = {}
        self._free_bytes = max_bytes

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def add(self, message: Message) -> bool:
        """Let a message wait; return False where its client has as many as it may, or as much."""
        client, size = bytes(message.delivered.publisher), len(message.delivered.message)
        if len(self._waiting.get(client, ())) >= EARLY_MAX or self._bytes.get(client, 0) + size > self._free_bytes:
            return False
        self._waiting.setdefault(client, deque()).append(message)
        self._bytes[client] = self._bytes.get(client, 0) + size
        self._free_bytes -= size
        return True

    def poll_messages(self, client: bytes) -> list[Message]:
        """Return, once, what waits of a client."""
        self._free_bytes += self._bytes.pop(client, 0)
        return list(self._waiting.pop(client, ()))

    def forget_all_but(self, clients: Collection[bytes]) -> int:
        """Forget what waits of clients that are gone; return how many messages that were."""
        return sum(len(self.poll_messages(client)) for client in self._waiting.keys() - clients)
