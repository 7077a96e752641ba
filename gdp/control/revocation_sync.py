"""Revocation synchronisation: two neighbours reconcile the trusted domains' revocations that they keep.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: anti-entropy by digests, as in ``replica.py``.

A neighbour that comes up gets digests, one for each trusted domain, and nothing else. If both ends' digests differ,
they exchange the digests of 256 buckets, and each requests what it lacks, with short ids of what it has. So only what
is missing crosses the link, and only towards a neighbour that is up and has requested it. Transfers are rate-limited,
and bounded for each neighbour's name, however often its sessions begin. Nothing is acknowledged: digests are repeated
when a transfer ends, and every ``AGAIN_S``.

::

    up ---> digests                           <- digests
            (differ) digests of buckets  ->   (differ) request for what is missing
            missing revocations, paced   ->
            digests                      ->
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gdp.control.neighbour import Neighbour
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.control.revoked import IDS_MAX, Lacking, Revoked
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, StatementType
from gdp.errors import DropReason, StatementError
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.token_bucket import TokenBuckets
from gdp.trust.revocations import BUCKETS, KeptKey, Revocations

__all__ = ["AGAIN_S", "PER_S", "RevocationSync"]

AGAIN_S: Final = 30.0  # digests are repeated, so that a lost flood is repaired
PER_S: Final = 1_000.0  # statements to one neighbour, about 3 Mbit/s
_TICK_S: Final = 0.02
_PER_TICK: Final = round(PER_S * _TICK_S)
_ASKS_PER_TICK: Final = 2
_SOON_S: Final = 0.5  # minimum time between digests to one neighbour's name
_REPLY_S: Final = 0.05  # ... or, if its digests differ, this shorter time
_TAKEN_PER_S, _TAKEN_BURST = 16.0, 256.0  # accepted of one neighbour
_SETTLE_S: Final = 0.3  # after a transfer, until the last statements have been processed
_FETCH_S: Final = 2.0  # without progress of a transfer another neighbour may be queried
_WINDOW_S: Final = 600.0  # in which a neighbour gets at most twice all there is
_SPARE: Final = 4_096  # ... and this many more
_NAMES_MAX: Final = 1_024

Say = Callable[[Neighbour, bytes], None]


@dataclass(slots=True, kw_only=True)
class _Peer:
    neighbour: Neighbour
    summary_at_s: float
    sends: deque[KeptKey] = field(default_factory=deque)
    sending: set[tuple[Name, int]] = field(default_factory=set)  # buckets that are among these
    asks: deque[tuple[Name, tuple[int, ...]]] = field(default_factory=deque)
    tick_at_s: float = 0.0


@dataclass(slots=True)
class _Drawn:
    """What one neighbour's name received in a window of time."""

    since_s: float
    count: int = 0


class RevocationSync:
    """Revocation synchronisation of one node.

    Args:
        say: sends a statement to a neighbour.
        first_sequence: above those of an earlier incarnation; wall-clock milliseconds suffice.
    """

    def __init__(
        self, identity: Identity, revoked: Revocations, hello_protocol: HelloProtocol, say: Say, first_sequence: int
    ) -> None:
        self._identity = identity
        self._revoked = revoked
        self._hello_protocol = hello_protocol
        self._say = say
        self._sequence = first_sequence
        self._peers: dict[tuple[int, Name], _Peer] = {}
        self._said_s: dict[Name, float] = {}  # when digests were sent to a name
        self._drawn: dict[Name, _Drawn] = {}
        self._taken = TokenBuckets(_TAKEN_PER_S, _TAKEN_BURST, _NAMES_MAX)
        self._received: dict[tuple[bytes, Name], int] = {}  # by session and name: the highest sequence number
        # domain to the neighbour that sends it, until when
        self._fetches: dict[Name, tuple[tuple[int, Name], float]] = {}

    def neighbour_up(self, neighbour: Neighbour, now_s: float) -> None:
        """Schedule digests for a neighbour that has come up, or has restarted."""
        at_s = max(now_s, self._said_s.get(neighbour.name, float("-inf")) + _SOON_S)
        self._peers[neighbour.port, neighbour.name] = _Peer(neighbour=neighbour, summary_at_s=at_s)

    def neighbour_lost(self, neighbour: Neighbour) -> None:
        """Forget a neighbour that is gone."""
        self._peers.pop((neighbour.port, neighbour.name), None)

    def receive(self, neighbour: Neighbour, statement: Statement, now: Timestamps) -> None:
        """Process a neighbour's digests, or its request.

        Raises:
            StatementError: MALFORMED, UNKNOWN_SENDER, BAD_SIGNATURE, REPLAYED or QUOTA.
        """
        peer = self._peers.get((neighbour.port, neighbour.name))
        if peer is None or statement.signer != neighbour.name:
            raise StatementError(DropReason.UNKNOWN_SENDER, "digests of revocations that the neighbour did not sign")
        said: Revoked | Lacking
        if statement.type is StatementType.REVOKED:
            said = Revoked.from_fields(statement.fields)
        else:
            said = Lacking.from_fields(statement.expect(StatementType.LACKING))
        session = self._hello_protocol.ports[neighbour.port].echo
        key = session, neighbour.name
        if said.session != session or said.sequence <= self._received.get(key, -1):
            raise StatementError(DropReason.REPLAYED, "digests of revocations")
        if not self._taken.spend(neighbour.name, now.mono_s):
            raise StatementError(DropReason.QUOTA, "digests of revocations")
        statement.verify(neighbour.key)
        self._note_sequence(key, said.sequence)
        if isinstance(said, Revoked):
            self._compare(peer, said, now)
        else:
            self._answer(peer, said, now.mono_s)

    def took(self, neighbour: Neighbour, domain: Name, now_s: float) -> None:
        """Note that a neighbour sent a revocation that was missing here; the others get digests after a delay."""
        key = neighbour.port, neighbour.name
        fetch = self._fetches.get(domain)
        if fetch is not None and fetch[0] == key:
            self._fetches[domain] = key, now_s + _FETCH_S
        for other, peer in self._peers.items():
            if other != key:
                peer.summary_at_s = min(max(peer.summary_at_s, now_s), now_s + _FETCH_S)

    def handle_timer(self, now_s: float) -> None:
        """Send what is due."""
        for peer in list(self._peers.values()):
            if peer.tick_at_s <= now_s and (peer.asks or peer.sends):
                self._tick(peer, now_s)
            if peer.summary_at_s <= now_s:
                self._tell(peer, now_s)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [peer.summary_at_s for peer in self._peers.values()]
        times += [peer.tick_at_s for peer in self._peers.values() if peer.asks or peer.sends]
        return min(times, default=None)

    def _note_sequence(self, key: tuple[bytes, Name], sequence: int) -> None:
        self._received.pop(key, None)
        self._received[key] = sequence
        if len(self._received) > _NAMES_MAX:
            del self._received[next(iter(self._received))]

    def _tell(self, peer: _Peer, now_s: float) -> None:
        """Send digests of everything."""
        name = peer.neighbour.name
        peer.summary_at_s = now_s + AGAIN_S
        self._said_s.pop(name, None)
        self._said_s[name] = now_s
        if len(self._said_s) > _NAMES_MAX:
            del self._said_s[next(iter(self._said_s))]
        self._send(peer, Revoked(peer.neighbour.echo, self._next(), tuple(self._revoked.summary())))

    def _compare(self, peer: _Peer, said: Revoked, now: Timestamps) -> None:
        """Request what is missing here, or send finer digests of what is here."""
        self._revoked.expire(now.unix_s)
        own = {domain: (count, digest) for domain, count, digest in self._revoked.summary()}
        if said.hashes:
            self._compare_buckets(peer, said, now.mono_s)
            return
        for domain, count, digest in said.domains:
            if domain not in own or own[domain][1] == digest:
                continue
            soon_s = self._said_s.get(peer.neighbour.name, float("-inf")) + _REPLY_S
            peer.summary_at_s = min(peer.summary_at_s, max(soon_s, now.mono_s))  # it may have to request, too
            if not own[domain][0]:
                self._ask(peer, domain, [()], now.mono_s)
            elif count:
                hashes = self._revoked.hashes(domain)
                assert hashes is not None
                self._send(peer, Revoked(peer.neighbour.echo, self._next(), (), domain, tuple(hashes)))

    def _compare_buckets(self, peer: _Peer, said: Revoked, now_s: float) -> None:
        own = self._revoked.hashes(said.domain)
        if own is None:
            return
        groups: list[tuple[int, ...]] = []
        capacity = 0
        for bucket in (at for at in range(BUCKETS) if own[at] != said.hashes[at]):
            size = len(self._revoked.ids(said.domain, bucket))
            if not groups or size > capacity:
                groups.append(())
                capacity = IDS_MAX
            groups[-1] = (*groups[-1], bucket)
            capacity -= size
        self._ask(peer, said.domain, groups, now_s)

    def _ask(self, peer: _Peer, domain: Name, groups: list[tuple[int, ...]], now_s: float) -> None:
        """Request what is missing of a domain, from one neighbour at a time."""
        key = peer.neighbour.port, peer.neighbour.name
        _, until_s = self._fetches.get(domain, (key, float("-inf")))
        if until_s > now_s or not groups:
            return  # the next digests will show whether anything is still missing
        self._fetches[domain] = key, now_s + _FETCH_S
        peer.asks.extend((domain, group) for group in groups)

    def _answer(self, peer: _Peer, said: Lacking, now_s: float) -> None:
        ids = frozenset(said.ids)
        for bucket in said.buckets or range(BUCKETS):
            if (said.domain, bucket) not in peer.sending:
                peer.sending.add((said.domain, bucket))
                peer.sends.extend(self._revoked.lacking(said.domain, bucket, ids))
        if peer.sends:
            peer.tick_at_s = max(peer.tick_at_s, now_s)
        else:
            peer.sending.clear()

    def _tick(self, peer: _Peer, now_s: float) -> None:
        """Send the next few statements."""
        peer.tick_at_s = now_s + _TICK_S
        for _ in range(min(_ASKS_PER_TICK, len(peer.asks))):
            domain, buckets = peer.asks.popleft()
            ids = [each for bucket in buckets for each in self._revoked.ids(domain, bucket)]
            self._send(peer, Lacking(peer.neighbour.echo, self._next(), domain, buckets, tuple(ids[:IDS_MAX])))
        for _ in range(min(_PER_TICK, len(peer.sends))):
            wire = self._revoked.wire(*peer.sends.popleft())
            if wire is not None and self._may_draw(peer.neighbour.name, now_s):
                self._say(peer.neighbour, wire)
        if not peer.sends and peer.sending:
            peer.sending.clear()
            peer.summary_at_s = min(peer.summary_at_s, now_s + _SETTLE_S)

    def _may_draw(self, name: Name, now_s: float) -> bool:
        drawn = self._drawn.get(name)
        if drawn is None or now_s - drawn.since_s >= _WINDOW_S:
            self._drawn.pop(name, None)
            drawn = self._drawn[name] = _Drawn(now_s)
            if len(self._drawn) > _NAMES_MAX:
                del self._drawn[next(iter(self._drawn))]
        drawn.count += 1
        return drawn.count <= 2 * len(self._revoked) + _SPARE

    def _send(self, peer: _Peer, said: Revoked | Lacking) -> None:
        self._say(peer.neighbour, said.to_wire(self._identity.name, self._identity.key))

    def _next(self) -> int:
        self._sequence += 1
        return self._sequence
