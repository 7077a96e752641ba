"""Liveness of the remote clients whose calls are under way.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from gdp.names import Name

__all__ = ["ClientLiveness"]

_AWAY_S: Final = 30.0  # a client that sends nothing for this long no longer waits


class ClientLiveness:
    """Time of the last sign of life of each client."""

    def __init__(self) -> None:
        self._heard_s: dict[Name, float] = {}

    def update(
        self, clients: Collection[Name], *, present: Collection[Name], known: Collection[bytes], now_s: float
    ) -> list[Name]:
        """Return the clients that have gone.

        Args:
            clients: those whose calls are under way.
            present: those that are reachable now.
            known: those that may become reachable again.
        """
        self._heard_s = {each: now_s if each in present else self._heard_s.get(each, now_s) for each in clients}
        return [
            client
            for client, heard_s in self._heard_s.items()
            if client not in present and (bytes(client) not in known or now_s - heard_s >= _AWAY_S)
        ]
