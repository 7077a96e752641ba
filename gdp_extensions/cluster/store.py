"""Cluster store: a RIB's routes in a Valkey or Redis Cluster, shared by any number of RIBs of one domain.

I/O; blocking, with short time limits (``cluster_link.py``). One round trip for each primary fetches the routes that the
core needs for one turn, and one more sends what it wrote. A function on the server decides whether an advertisement is
newer, so RIBs that write at the same time agree. Leases are the expiry of keys by the servers' clock, so the clock of
one RIB ends none. A change is published on the channel of its slot. Data from the cluster is verified like data from a
peer: the store must be available, but is not trusted.
"""

from __future__ import annotations

import heapq
import secrets
import zlib
from collections import Counter, OrderedDict
from collections.abc import Collection
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Annotated, Final

from gdp.control.rib_replication import Key
from gdp.control.rib_statements import TRANSIT_MAX
from gdp.crypto.schema import CERT, NAME, STATEMENT, FieldSet, Keyed, many
from gdp.crypto.statements import parse
from gdp.errors import DropReason, LocalError, RemoteError, StatementError, StoreError
from gdp.names import NAME_BYTES, Name
from gdp.rib.route import Route, Withdrawn
from gdp.sansio import Timestamps
from gdp.trust.advertisement import UnverifiedAdvertisement
from gdp.trust.verifier import AdvertisementVerifier
from gdp_extensions.cluster.link import ClusterLink, Command, tag_of

FUNCTIONS: Final = Path(__file__).with_name("functions.lua")
CACHE_MAX: Final = 65_536  # names
CONTEXTS_MAX: Final = 16_384
_ID_BYTES: Final = 16
_RECORD_BYTES: Final = NAME_BYTES + 8 + 8 + 4
_SEQUENCE_MAX: Final = (1 << 64) - 1
_KEPT, _NEWER, _NO_CONTEXT = 1, 0, 2
_NO_FUNCTION: Final = "Function not found"


def load_functions(link: ClusterLink) -> bool:
    """Load the functions into every primary; the primaries replicate them.

    Returns:
        Whether each primary has them; one that does not respond must be tried again.

    Raises:
        LocalError: a server refuses them.
    """
    code = FUNCTIONS.read_text()
    replies = link.ask_primaries((b"FUNCTION LOAD", b"REPLACE", code))
    for reply in replies:
        if isinstance(reply, LocalError):
            raise LocalError(f"the cluster does not take the RIB's functions: {reply}") from reply
    return not any(isinstance(reply, StoreError) for reply in replies)


@dataclass(slots=True)
class _Write:
    """A route or a withdrawal to send."""

    key: Key
    sequence: int
    tag: bytes
    command: Command
    context: bytes = b""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Context(FieldSet):
    """What a node's advertisements at one sender share."""

    sender: Annotated[Name, Keyed("w", NAME)]
    domain: Annotated[Name, Keyed("d", NAME)]
    via: Annotated[Name, Keyed("v", NAME)]
    transit: Annotated[tuple[Name, ...], Keyed("x", many(NAME, TRANSIT_MAX))]
    membership: Annotated[bytes, Keyed("m", CERT)]
    rtcert: Annotated[bytes, Keyed("r", STATEMENT)]


class ClusterStore:
    """Store of RIBs that share a cluster.

    Args:
        verifier: of the RIB: every route is verified when it is read, before it is used.

    Attributes:
        lacks_functions: a primary said that it has no functions; ``load_functions`` brings them.
    """

    def __init__(self, link: ClusterLink, verifier: AdvertisementVerifier) -> None:
        self._link = link
        self._verifier = verifier
        self._me = secrets.token_bytes(8)
        self._now = Timestamps(0.0, 0.0)
        self._cache: OrderedDict[Name, dict[Name, Route]] = OrderedDict()
        self._contexts: OrderedDict[bytes, bytes] = OrderedDict()  # by hash tag and id
        self._minimums: OrderedDict[Key, Withdrawn] = OrderedDict()  # newer sequence numbers that the cluster reported
        self._writes: list[_Write] = []
        self._ends: list[tuple[float, Name, Name]] = []
        self._owners: dict[Name, dict[int, float]] = {}  # ends of leases, by sender and by advertiser
        self.refusals: Counter[DropReason] = Counter()  # invalid records that were read, by reason
        self.digests = None
        self.lacks_functions = False

    def __len__(self) -> int:
        return sum(map(len, self._cache.values()))

    def prefetch(self, names: Collection[Name], now: Timestamps) -> None:
        """Read the names that are not in memory, in one round trip for each primary.

        Names that could not be read raise on their next use.
        """
        self._now = now
        wanted = [name for name in dict.fromkeys(names) if name not in self._cache]
        replies = self._link.execute(
            [(tag_of(name), (b"FCALL", b"gdp_rib_get", 1, _routes_key(name))) for name in wanted]
        )
        for name, reply in zip(wanted, replies, strict=True):
            if isinstance(reply, list) and (present_ms := _code(reply)) is not None and isinstance(reply[1], bytes):
                self._keep(name, self._decoded(name, reply[1], present_ms))
            else:
                self._note_failure(reply)

    def routes(self, name: Name) -> list[Route]:
        """Return a name's routes."""
        return list(self._of(name).values())

    def get(self, name: Name, advertiser: Name) -> Route | Withdrawn | None:
        """Return the route or withdrawal of one advertiser of a name, None if there is none."""
        route = self._of(name).get(advertiser)
        return route if route is not None else self._minimums.get((name, advertiser))

    def put(self, route: Route) -> None:
        """Add or replace a route; ``commit`` reports whether the cluster accepted it."""
        self._of(route.name)[route.advertiser] = route
        self._minimums.pop((route.name, route.advertiser), None)
        heapq.heappush(self._ends, (route.expires_s, route.name, route.advertiser))
        for owner in (route.sender, route.advertiser):
            self._owners.setdefault(owner, {})[hash((route.name, route.advertiser))] = route.expires_s
        if not route.is_from_upstream:
            self._writes.append(self._put_command(route))

    def withdraw(self, name: Name, advertiser: Name, withdrawn: Withdrawn | None = None) -> Route | None:
        """Remove a route and return it."""
        route = self._of(name).pop(advertiser, None)
        if route is None and withdrawn is None:
            return None
        if withdrawn is None and route is not None:
            withdrawn = Withdrawn(route.sender, route.sequence, route.valid_until_unix_s)
        assert withdrawn is not None
        tag = tag_of(name)
        sequence = withdrawn.sequence.to_bytes(8, "big")
        until = withdrawn.valid_until_unix_s * 1_000
        command: Command = (
            *(b"FCALL", b"gdp_rib_withdraw", 2, _routes_key(name), _sequence_key(name, advertiser)),
            *(bytes(advertiser), sequence, until, tag, self._me + name),
        )
        if route is None or not route.is_from_upstream:
            self._writes.append(_Write((name, advertiser), withdrawn.sequence, tag, command))
        self._set_minimum((name, advertiser), withdrawn)
        return route

    def commit(self) -> list[Key]:
        """Send the writes; return the rejected keys: another RIB's entry is newer, or the cluster failed."""
        writes, self._writes = self._writes, []
        if not writes:
            return []
        replies = self._link.execute([(write.tag, write.command) for write in writes], writes=True)
        again = [at for at, reply in enumerate(replies) if _code(reply) == _NO_CONTEXT]
        with_context = [(writes[at].tag, _with_context(writes[at])) for at in again]
        for at, reply in zip(again, self._link.execute(with_context, writes=True), strict=True):
            replies[at] = reply
        refused = []
        for write, reply in zip(writes, replies, strict=True):
            if _code(reply) == _KEPT:
                continue
            refused.append(write.key)
            self._cache.pop(write.key[0], None)
            if isinstance(reply, list) and _code(reply) == _NEWER:
                held = int.from_bytes(reply[1], "big")
                self._set_minimum(write.key, Withdrawn(write.key[1], held, int(self._now.unix_s) + 1))
            else:
                self.refusals[DropReason.UNAVAILABLE] += 1
                self._note_failure(reply)
        return refused

    def expire(self, now_s: float, unix_s: float) -> list[Route]:
        """Remove and return the routes in memory whose lease ended; the cluster expires its own."""
        self._now = Timestamps(now_s, unix_s)
        gone = []
        while self._ends and self._ends[0][0] <= now_s:
            _, name, advertiser = heapq.heappop(self._ends)
            routes = self._cache.get(name, {})
            route = routes.get(advertiser)
            if route is not None and route.expires_s <= now_s:
                del routes[advertiser]
                gone.append(route)
        return gone

    def next_expiry(self) -> float | None:
        """Return a monotonic second no later than the next end of a lease in memory, or None."""
        return self._ends[0][0] if self._ends else None

    def count_of(self, owner: Name) -> int:
        """Return how many valid routes of a sender or a node came through this RIB."""
        held = self._owners.get(owner, {})
        if len(held) > 1_000 and min(held.values()) <= self._now.mono_s:
            held = self._owners[owner] = {key: end for key, end in held.items() if end > self._now.mono_s}
        return len(held)

    def resting_on(self, mark: bytes) -> list[Route]:
        """Return the routes in memory that depend on a certificate or a key; others are checked when read."""
        every = (route for routes in self._cache.values() for route in routes.values())
        return [route for route in every if mark in route.fingerprints or mark in route.issuers]

    def has_issuer(self, key: bytes) -> bool:
        """Return whether a route in memory depends on a certificate that this key, 33 bytes, issued; scans all."""
        return any(key in route.issuers for routes in self._cache.values() for route in routes.values())

    def changed(self) -> list[tuple[Name, list[Route]]]:
        """Return the names that other RIBs changed since the last call, each with the routes that were in memory."""
        found: dict[Name, list[Route]] = {}
        if self._link.listen():
            self._forget_all(found)  # changes before the subscription are unknown
        for notification in self._link.notifications():
            if notification[:8] != self._me:
                name = Name(notification[8:])
                found.setdefault(name, list(self._cache.pop(name, {}).values()))
        return list(found.items())

    # -- memory

    def _of(self, name: Name) -> dict[Name, Route]:
        """Return a name's routes in memory, read from the cluster if they are missing.

        Raises:
            StoreError: the cluster did not respond.
        """
        routes = self._cache.get(name)
        if routes is None:
            self.prefetch([name], self._now)
            routes = self._cache.get(name)
            if routes is None:
                raise StoreError("the cluster did not answer")
        return routes

    def _note_failure(self, reply: object) -> None:
        self.lacks_functions |= isinstance(reply, LocalError) and _NO_FUNCTION in str(reply)

    def _keep(self, name: Name, routes: dict[Name, Route]) -> None:
        self._cache[name] = routes
        while len(self._cache) > CACHE_MAX:
            self._cache.popitem(last=False)
        for route in routes.values():
            heapq.heappush(self._ends, (route.expires_s, route.name, route.advertiser))

    def _set_minimum(self, key: Key, withdrawn: Withdrawn) -> None:
        self._minimums[key] = withdrawn
        while len(self._minimums) > CACHE_MAX:
            self._minimums.popitem(last=False)

    def _forget_all(self, found: dict[Name, list[Route]]) -> None:
        for name, routes in self._cache.items():
            found[name] = list(routes.values())
        self._cache.clear()

    # -- records

    def _put_command(self, route: Route) -> _Write:
        """Return the call of the server's function.

        The context that a node's advertisements share is the dictionary of the compression.
        """
        body = UnverifiedAdvertisement.from_statement(parse(route.advertisement))
        context = _Context(
            sender=route.sender,
            domain=route.domain,
            via=route.via,
            transit=route.transit,
            membership=body.membership,
            rtcert=body.rtcert,
        ).to_cbor()
        tag = tag_of(route.name)
        context_id = blake2b(context, digest_size=_ID_BYTES).digest()
        squeeze = zlib.compressobj(6, zlib.DEFLATED, -15, zdict=context)
        data = context_id + squeeze.compress(route.advertisement) + squeeze.flush()
        left_ms = max(int((route.expires_s - self._now.mono_s) * 1_000), 0)
        keys = (_routes_key(route.name), _sequence_key(route.name, route.advertiser), _context_key(tag, context_id))
        sequence = min(route.sequence, _SEQUENCE_MAX).to_bytes(8, "big")
        command: Command = (
            *(b"FCALL", b"gdp_rib_put", 3, *keys, bytes(route.advertiser), sequence, left_ms, data),
            *(route.valid_until_unix_s * 1_000, b"", tag, self._me + route.name),
        )
        return _Write((route.name, route.advertiser), route.sequence, tag, command, context)

    def _decoded(self, name: Name, value: bytes, present_ms: int) -> dict[Name, Route]:
        """Return the valid routes in a value, read at a time of the server's clock; invalid ones are counted."""
        routes: dict[Name, Route] = {}
        at = 0
        while at + _RECORD_BYTES <= len(value):
            end_ms = int.from_bytes(value[at + 40 : at + 48], "big")
            stop = at + _RECORD_BYTES + int.from_bytes(value[at + 48 : at + _RECORD_BYTES], "big")
            try:
                route = self._route(name, value[at + _RECORD_BYTES : stop], (end_ms - present_ms) / 1_000)
                if route.expires_s > self._now.mono_s:
                    routes[route.advertiser] = route
            except RemoteError as error:
                self.refusals[error.reason] += 1
            at = stop
        return routes

    def _route(self, name: Name, data: bytes, left_s: float) -> Route:
        context = self._context(tag_of(name), data[:_ID_BYTES])
        try:
            advertisement_wire = zlib.decompressobj(-15, zdict=context).decompress(data[_ID_BYTES:], 1 << 16)
        except zlib.error as error:
            raise StatementError(DropReason.MALFORMED, "a record of the store") from error
        shared = _Context.from_cbor(context)
        advertisement = self._verifier.verify(advertisement_wire, self._now.unix_s)
        if advertisement.name != name:
            raise StatementError(DropReason.WRONG_NAME, "a record of the store under another name")
        return Route.of(
            advertisement,
            sender=shared.sender,
            domain=shared.domain,
            via=shared.via,
            transit=shared.transit,
            expires_s=self._now.mono_s + min(left_s, advertisement.lease_s),
        )

    def _context(self, tag: bytes, context_id: bytes) -> bytes:
        known = self._contexts.get(tag + context_id)
        if known is None:
            (reply,) = self._link.execute([(tag, (b"GET", _context_key(tag, context_id)))])
            if not isinstance(reply, bytes):
                raise StatementError(DropReason.UNAVAILABLE, "a context that is not there")
            known = self._contexts[tag + context_id] = reply
            while len(self._contexts) > CONTEXTS_MAX:
                self._contexts.popitem(last=False)
        return known


def _routes_key(name: Name) -> bytes:
    return tag_of(name) + b"r" + name


def _sequence_key(name: Name, advertiser: Name) -> bytes:
    return tag_of(name) + b"s" + blake2b(name + advertiser, digest_size=_ID_BYTES).digest()


def _context_key(tag: bytes, context_id: bytes) -> bytes:
    return tag + b"c" + context_id


def _with_context(write: _Write) -> Command:
    """Return the call with the context, which the server reported as missing."""
    return (*write.command[:-3], write.context, *write.command[-2:])


def _code(reply: object) -> int | None:
    return reply[0] if isinstance(reply, list) and len(reply) == 2 and isinstance(reply[0], int) else None
