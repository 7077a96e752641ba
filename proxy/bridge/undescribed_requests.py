"""Queue of requests whose client is not described yet, with a fair quota for each client."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import Final

from gdp.client.participant import Message

EARLY_MAX: Final = 256  # of one client
EARLY_MAX_BYTES: Final = 64 << 20  # of all clients; one client may use as much as it leaves free for others


class UndescribedRequests:
    """Waiting messages by client, in order."""

    def __init__(self, max_bytes: int = EARLY_MAX_BYTES) -> None:
        self._waiting: dict[bytes, deque[Message]] = {}
        self._bytes: dict[bytes, int] = {}
        self._free_bytes = max_bytes

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def add(self, message: Message) -> bool:
        """Add a message; return False where its client has used its quota of messages or bytes."""
        client, size = bytes(message.delivered.publisher), len(message.delivered.message)
        if len(self._waiting.get(client, ())) >= EARLY_MAX or self._bytes.get(client, 0) + size > self._free_bytes:
            return False
        self._waiting.setdefault(client, deque()).append(message)
        self._bytes[client] = self._bytes.get(client, 0) + size
        self._free_bytes -= size
        return True

    def poll_messages(self, client: bytes) -> list[Message]:
        """Remove and return the waiting messages of a client."""
        self._free_bytes += self._bytes.pop(client, 0)
        return list(self._waiting.pop(client, ()))

    def forget_all_but(self, clients: Collection[bytes]) -> int:
        """Drop the messages of clients that are gone; return their number."""
        return sum(len(self.poll_messages(client)) for client in self._waiting.keys() - clients)
