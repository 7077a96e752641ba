"""Replication between the RIBs of one domain: each stores what any of them accepts, routes and endpoint records.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Changes are pushed at once; ``exchange/anti_entropy.py`` finds
what was lost. The RIB's core decides whether an entry is accepted: entries prove themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final

from gdp.crypto.identity import Identity
from gdp.exchange.anti_entropy import AntiEntropy, SyncPace
from gdp.exchange.sync_message import SyncMessage
from gdp.exchange.sync_set import SyncSet
from gdp.names import Name

__all__ = ["ROUTES", "Replication"]

COLD_S: Final = 3.0  # a RIB that just started denies no name before it compared with a peer, for so long at most
PEERS_MAX: Final = 16
ROUTES: Final = b"routes"  # without it, several RIBs share the store itself
_PACE: Final = SyncPace(total_s=1.0, soon_s=0.2, fetch_s=0.5, reply_s=0.005, reply_bytes=128 << 10, draws=64)


class Replication:
    """One RIB's exchange with its peers.

    Args:
        sets: what is replicated, by identifier.
        item_of: as of ``AntiEntropy``.
        peers: the RIBs to begin with; others of the domain are added when their first message comes.
    """

    def __init__(
        self,
        identity: Identity,
        sets: Mapping[bytes, SyncSet[Any]],
        item_of: Callable[[bytes, bytes, float], bytes | None],
        peers: Iterable[Name],
    ) -> None:
        self._identity = identity
        self._exchange = AntiEntropy[Name](sets, item_of, _PACE)
        for peer in peers:
            self.add_peer(peer, float("-inf"))
        self._started_s: float | None = None
        self._is_warm = not self.peers or ROUTES not in sets

    @property
    def peers(self) -> tuple[Name, ...]:
        """Return the known RIBs of the domain."""
        return self._exchange.peers

    def is_cold(self, now_s: float) -> bool:
        """Return whether this RIB may still lack what its peers hold."""
        is_late = self._started_s is not None and now_s - self._started_s >= COLD_S
        self._is_warm = self._is_warm or is_late or ROUTES in self._exchange.compared
        return not self._is_warm

    def add_peer(self, name: Name, now_s: float) -> bool:
        """Add a RIB that proved to be of this domain; return whether it is a peer now."""
        if name not in self.peers:
            if len(self.peers) >= PEERS_MAX or name == self._identity.name:
                return False
            self._exchange.add_peer(name, name, now_s)
        return True

    def push(self, of: bytes, key: bytes) -> None:
        """Push the item of a key to all peers."""
        self._exchange.push(of, key)

    def receive(self, message: SyncMessage, sender: Name, now_s: float) -> tuple[bytes, ...]:
        """Handle a peer's message; return the items in it, for the caller to read, to verify and to store."""
        return self._exchange.receive_message(sender, message, now_s)

    def connected(self, now_s: float) -> None:
        """Begin: messages reach the peers from now on."""
        if self._started_s is None:
            self._started_s = now_s
        self._exchange.announce(now_s)

    def handle_timer(self, now_s: float) -> None:
        """Send what is due; give up replies that did not come."""
        self._exchange.handle_timer(now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return self._exchange.get_timer()

    def statements_to_send(self, now_s: float) -> list[tuple[Name, bytes]]:
        """Return, once, statements to send, each with the peer it is for."""
        wires: dict[int, bytes] = {}  # a message that is pushed to all is signed once
        messages = self._exchange.poll_messages(now_s)
        for _, message in messages:
            if id(message) not in wires:
                wires[id(message)] = message.to_wire(self._identity.name, self._identity.key, self._identity.membership)
        return [(peer, wires[id(message)]) for peer, message in messages]
