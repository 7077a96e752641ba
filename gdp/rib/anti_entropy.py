"""Anti-entropy between the RIBs of one domain: each stores what any of them accepts.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Changes are pushed at once and unacknowledged. Once a second
each RIB sends its peers a hash over all its entries. A RIB whose hash differs fetches the detail, level by level, and
then the entries that it lacks. The fetching side drives this, one request under way for each peer, so that the slower
of both sets the pace. The RIB's core decides whether an entry is accepted: entries prove themselves.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from gdp.control.rib_replication import (
    FETCH_KEYS_MAX,
    FETCH_PREFIXES_MAX,
    HASH_BYTES,
    INVENTORY_MAX,
    PREFIX_MAX_BYTES,
    Digest,
    Entry,
    EntryBatch,
    Fetch,
    Inventory,
    Item,
    Key,
    batches,
)
from gdp.crypto.identity import Identity
from gdp.names import Name
from gdp.rib.digest_tree import DigestTree

__all__ = ["AntiEntropy"]

DIGEST_S: Final = 1.0
ANSWER_DIGEST_S: Final = 0.2  # a peer that differs also receives our hash, at most this often
FETCH_S: Final = 0.5  # a reply that is incomplete by then is cancelled; the next digest begins again
COLD_S: Final = 3.0  # a RIB that just started denies no name before the first message of a peer, for so long at most
PEERS_MAX: Final = 16
QUEUE_MAX: Final = 65_536

Message = Digest | Fetch | Inventory | EntryBatch


@dataclass(slots=True)
class _Peer:
    prefixes: deque[bytes] = field(default_factory=deque)
    keys: deque[Key] = field(default_factory=deque)
    until_s: float | None = None  # when the reply under way is cancelled
    digest_sent_s: float = float("-inf")

    @property
    def is_idle(self) -> bool:
        return self.until_s is None and not self.prefixes and not self.keys


class AntiEntropy:
    """One RIB's exchange with its peers.

    Args:
        peers: the RIBs to begin with; others of the domain are added when their first message comes.
        entry_of: returns the stored entry of a key at a monotonic second, or None.
        rank_of: returns ``Item.rank`` of the stored entry of a key, or None.
    """

    def __init__(
        self,
        identity: Identity,
        digests: DigestTree,
        peers: Iterable[Name],
        entry_of: Callable[[Key, float], Entry | None],
        rank_of: Callable[[Key], int | None],
    ) -> None:
        self._identity = identity
        self._digests = digests
        self._peers = {peer: _Peer() for peer in peers if peer != identity.name}
        self._entry_of = entry_of
        self._rank_of = rank_of
        self._news: dict[Key, None] = {}
        self._out: list[tuple[Name, bytes]] = []
        self._digest_at_s = float("-inf")
        self._started_s: float | None = None
        self._is_warm = not self._peers

    @property
    def peers(self) -> tuple[Name, ...]:
        """Return the known RIBs of the domain."""
        return tuple(self._peers)

    def is_cold(self, now_s: float) -> bool:
        """Return whether this RIB may still lack what its peers hold."""
        if not self._is_warm and self._started_s is not None and now_s - self._started_s >= COLD_S:
            self._is_warm = True
        return not self._is_warm

    def add_peer(self, name: Name) -> bool:
        """Add a RIB that proved to be of this domain; return whether it is a peer now."""
        if name not in self._peers:
            if len(self._peers) >= PEERS_MAX or name == self._identity.name:
                return False
            self._peers[name] = _Peer()
        return True

    def push_entry(self, key: Key) -> None:
        """Push the stored entry of a key to all peers."""
        if self._peers:
            self._news[key] = None

    def receive(self, message: Message, sender: Name, now_s: float) -> Sequence[Entry]:
        """Handle a peer's message; return the entries in it, for the caller to verify and to store."""
        peer = self._peers[sender]
        if isinstance(message, Digest):
            self._compare(message, sender, peer, now_s)
        elif isinstance(message, Inventory):
            self._take_inventory(message, sender, peer, now_s)
        elif isinstance(message, Fetch):
            self._serve(message, sender, now_s)
        elif isinstance(message, EntryBatch):
            if message.is_last:
                self._reply_ended(sender, peer, now_s)
            return message.entries
        return ()

    def connected(self, now_s: float) -> None:
        """Begin: messages reach the peers from now on."""
        if self._started_s is None:
            self._started_s = now_s
        self._digest_at_s = now_s

    def handle_timer(self, now_s: float) -> None:
        """Send digests when due; cancel replies that did not come."""
        for name, peer in self._peers.items():
            if peer.until_s is not None and peer.until_s <= now_s:
                peer.prefixes.clear()
                peer.keys.clear()
                peer.until_s = None
            if self._digest_at_s <= now_s:
                self._send_total(name, peer, now_s)
        if self._digest_at_s <= now_s:
            self._digest_at_s = now_s + DIGEST_S

    def next_due(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        if not self._peers:
            return None
        times = [peer.until_s for peer in self._peers.values() if peer.until_s is not None]
        return min([self._digest_at_s, *times])

    def statements_to_send(self, now_s: float) -> list[tuple[Name, bytes]]:
        """Return, once, statements to send, each with the peer it is for."""
        if self._news:
            found = (self._entry_of(key, now_s) for key in self._news)
            for group in batches([entry for entry in found if entry is not None]):
                wire = self._signed(EntryBatch(group, is_last=False))
                self._out += [(peer, wire) for peer in self._peers]
            self._news.clear()
        out, self._out = self._out, []
        return out

    # -- entries of the peer

    def _compare(self, digest: Digest, sender: Name, peer: _Peer, now_s: float) -> None:
        if len(digest.hashes) == HASH_BYTES:
            self._compare_total(digest, sender, peer, now_s)
            return
        if len(digest.prefix) < PREFIX_MAX_BYTES and len(peer.prefixes) < QUEUE_MAX:
            peer.prefixes.extendleft(reversed(self._digests.differing(digest.prefix, digest.hashes)))
        if digest.is_last:
            self._reply_ended(sender, peer, now_s)

    def _compare_total(self, digest: Digest, sender: Name, peer: _Peer, now_s: float) -> None:
        if digest.hashes == self._digests.total:
            self._is_warm = True
            return
        if now_s - peer.digest_sent_s >= ANSWER_DIGEST_S:
            self._send_total(sender, peer, now_s)
        if peer.is_idle:
            peer.prefixes.append(b"")
            self._fetch(sender, peer, now_s)

    def _take_inventory(self, inventory: Inventory, sender: Name, peer: _Peer, now_s: float) -> None:
        newer_here: list[Item] = []
        for item in inventory.items:
            known = self._rank_of(item.key)
            if known is None or known < item.rank:
                if len(peer.keys) < QUEUE_MAX:
                    peer.keys.append(item.key)
            elif known > item.rank:
                newer_here.append(item)
        found = (self._entry_of(item.key, now_s) for item in newer_here)
        for group in batches([entry for entry in found if entry is not None]):
            self._out.append((sender, self._signed(EntryBatch(group, is_last=False))))
        if inventory.is_last:
            self._reply_ended(sender, peer, now_s)

    def _reply_ended(self, sender: Name, peer: _Peer, now_s: float) -> None:
        peer.until_s = None
        if peer.is_idle:
            self._is_warm = True
        else:
            self._fetch(sender, peer, now_s)

    def _fetch(self, sender: Name, peer: _Peer, now_s: float) -> None:
        """Request entries first, so that the queue of prefixes is processed depth first and stays short."""
        prefixes: list[bytes] = []
        keys = [peer.keys.popleft() for _ in range(min(len(peer.keys), FETCH_KEYS_MAX))]
        if not keys:
            prefixes = [peer.prefixes.popleft() for _ in range(min(len(peer.prefixes), FETCH_PREFIXES_MAX))]
        peer.until_s = now_s + FETCH_S
        self._out.append((sender, self._signed(Fetch(tuple(prefixes), tuple(keys)))))

    # -- entries of this RIB

    def _serve(self, fetch: Fetch, sender: Name, now_s: float) -> None:
        replies: list[Message] = []
        items: list[Item] = []
        for prefix in fetch.prefixes:
            if len(prefix) < PREFIX_MAX_BYTES and self._digests.count(prefix) > INVENTORY_MAX:
                replies.append(Digest(prefix, self._digests.hashes(prefix), is_last=False))
            else:
                items += self._digests.items(prefix)
        pages = [tuple(items[at : at + INVENTORY_MAX]) for at in range(0, len(items), INVENTORY_MAX)]
        replies += [Inventory(page, is_last=False) for page in pages]
        found = (self._entry_of(key, now_s) for key in fetch.keys)
        replies += [EntryBatch(group, is_last=False) for group in batches([each for each in found if each is not None])]
        replies.append(Inventory((), is_last=True))
        self._out += [(sender, self._signed(reply)) for reply in replies]

    def _send_total(self, name: Name, peer: _Peer, now_s: float) -> None:
        peer.digest_sent_s = now_s
        self._out.append((name, self._signed(Digest(b"", self._digests.total, is_last=False))))

    def _signed(self, message: Message) -> bytes:
        return message.to_wire(self._identity.name, self._identity.key, self._identity.membership)
