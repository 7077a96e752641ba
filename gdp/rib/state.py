"""State of a RIB's core: its parts, and what it counts.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). The handlers of statements read and change it; ``core.py`` has
their table. A handler raises ``StatementError`` for a statement that it refuses, and ``StoreError`` where a shared
store did not respond.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

from gdp.control.endpoints import ENDPOINTS
from gdp.control.presence import IdentityChecks
from gdp.control.rib_replication import Entry, Key
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement
from gdp.errors import DropReason, StatementError
from gdp.exchange.anti_entropy import AntiEntropy, SyncPace
from gdp.intervals import ADVERTISEMENT, LEASE_MAX_S, NEVER_S, Rate
from gdp.limits import ANSWER_BYTES_RATE, RIB_NAMES_PER_SENDER, RIB_WATCHES_MAX
from gdp.names import NAME_BYTES, Name
from gdp.rib.endpoints import RibEndpoints
from gdp.rib.outbox import RibOutbox
from gdp.rib.route import Route
from gdp.rib.store import Store
from gdp.rib.upstream_advertisements import QUIET_S, UpstreamAdvertisements
from gdp.rib.upstream_queries import UpstreamQueries
from gdp.sansio import Timestamps
from gdp.token_bucket import TokenBuckets
from gdp.trust.domain import Policy
from gdp.trust.lru import Lru
from gdp.trust.verifier import AdvertisementVerifier

if TYPE_CHECKING:
    from gdp.diagnosis.facts import GoneFact

_NAMES_MAX: Final = 4_096  # whose former advertisers are kept
_ADVERTISERS_MAX: Final = 16  # of one name
_LAPSED: Final = "lapsed"
_WITHDREW: Final = "withdrew"
_Gone: TypeAlias = tuple[str, Name, Name]  # how, and its last switch and that one's domain
PEERS_MAX: Final = 16
ROUTES: Final = b"routes"  # without it, several RIBs share the store itself
_PACE: Final = SyncPace(total_s=1.0, soon_s=0.2, fetch_s=0.5, reply_s=0.005, reply_bytes=128 << 10, draws=64)
_PASSED_RATE: Final = Rate(8.0, burst=128.0)  # revocations forwarded to the tier above, of one sender
_SENT_RATE: Final = Rate(64.0, burst=2_048.0)  # revocations to one asker, of what it lacks


@dataclass(slots=True)
class _Rib:
    probed_s: float = -NEVER_S
    heard_s: float = -NEVER_S
    returned_s: float = -NEVER_S
    is_silent: bool = False


class LowerRibs:
    """What probes say of the RIBs of the tiers below whose routes lapsed; others are not recorded.

    A lease ends with its advertiser only where the RIB that relayed the advertisement is alive: it answers a probe. The
    routes of a silent RIB are kept, as those of a silent tier above are (RFC 8767 in spirit). A RIB that is back has
    half a lease to relay them again.
    """

    def __init__(self) -> None:
        self._ribs: dict[Name, _Rib] = {}

    def record_alive(self, rib: Name, now_s: float) -> None:
        """Record a sign of life."""
        known = self._ribs.get(rib)
        if known is not None:
            known.heard_s = now_s
            if known.is_silent:
                known.is_silent, known.returned_s = False, now_s

    def keep_s(self, rib: Name, now_s: float) -> float:
        """Return for how many seconds to keep a route that a RIB did not renew; 0: the RIB is alive, the lease ends."""
        known = self._ribs.setdefault(rib, _Rib())
        since_s = now_s - known.probed_s
        if known.heard_s < known.probed_s and since_s >= QUIET_S:
            known.is_silent = True
        if known.is_silent:
            return ADVERTISEMENT.lease_s / 2  # it renews within a third
        left_s = known.returned_s + ADVERTISEMENT.lease_s / 2 - now_s
        if left_s > 0.0:
            return left_s
        return 0.0 if known.heard_s >= known.probed_s and since_s <= 2 * QUIET_S else QUIET_S

    def is_probe_due(self, rib: Name, now_s: float) -> bool:
        """Return whether to probe a RIB whose routes are kept; that counts as done."""
        known = self._ribs.setdefault(rib, _Rib())
        is_due = now_s - known.probed_s >= QUIET_S
        if is_due:
            known.probed_s = now_s
        return is_due


class FormerAdvertisers:
    """How advertisers of names left, and why an advertisement was refused last, for diagnoses.

    Bounded: of too many, those that were noted or asked for longest ago are forgotten.
    """

    def __init__(self) -> None:
        self._gone: Lru[dict[Name, _Gone]] = Lru(_NAMES_MAX)
        self._refused: Lru[str] = Lru(_NAMES_MAX)

    def note_gone(self, route: Route, *, is_lapsed: bool) -> None:
        """Note that an advertiser withdrew a name, or that its lease ended."""
        known = self._gone.get(route.name) or {}
        known.pop(route.advertiser, None)
        known[route.advertiser] = (_LAPSED if is_lapsed else _WITHDREW, route.switch, route.domain)
        if len(known) > _ADVERTISERS_MAX:
            del known[next(iter(known))]
        self._gone.put(route.name, known)

    def note_refused(self, name: Name, reason: DropReason) -> None:
        """Note why an advertisement of a name was refused."""
        self._refused.put(name, reason.label)

    def gone(self, name: Name) -> tuple[GoneFact, ...]:
        """Return the advertisers of a name that left, those that are back included."""
        from gdp.diagnosis.facts import GoneFact  # a node gathers facts for who asks

        return tuple(
            GoneFact(advertiser=each.to_text(), how=how, switch=switch.to_text(), domain=domain.to_text())
            for each, (how, switch, domain) in (self._gone.get(name) or {}).items()
        )

    def refused(self, name: Name) -> str:
        """Return the label of the newest refusal of a name, or an empty text."""
        return self._refused.get(name) or ""


@dataclass(frozen=True, slots=True, kw_only=True)
class RibSettings:
    """Options of an operator.

    Args:
        upper: RIBs of the tier above, any of which may be used, the preferred one first; after them RIBs of the tier
            above that, which are used while none of the former responds. Empty at the top.
        peers: other RIBs of this domain, with which this one replicates.
    """

    upper: tuple[Name, ...] = ()
    peers: tuple[Name, ...] = ()
    allow_unowned: bool = False
    names_per_sender: int = RIB_NAMES_PER_SENDER
    watches: int = RIB_WATCHES_MAX
    lease_max_s: float = LEASE_MAX_S


class RibCoreState:
    """State of one RIB.

    Attributes:
        sets: what this RIB equalises with its peers, by identifier.
        exchange: with peers, at first those of the settings; others are added when their first message comes.
        started_s: since when messages reach the peers, or None.
        is_warm: whether this RIB may deny names: it holds what its peers hold.
        now_s: monotonic seconds of the last call.
    """

    def __init__(self, identity: Identity, policy: Policy, store: Store, settings: RibSettings) -> None:
        self.identity = identity
        self.policy = policy
        self.store = store
        self.settings = settings
        self.verifier = AdvertisementVerifier(policy, allow_unowned=settings.allow_unowned)
        self.outbox = RibOutbox(identity, policy, store, settings.watches)
        self.upstream_queries = UpstreamQueries(is_top=not settings.upper)
        self.upstream = UpstreamAdvertisements(settings.upper)
        self.lower = LowerRibs()
        self.endpoints = RibEndpoints(
            identity, policy, lambda name: self.exchange.push(ENDPOINTS, name), settings.watches
        )
        self.sets = {ENDPOINTS: self.endpoints.records} | ({} if store.digests is None else {ROUTES: store.digests})
        self.exchange = AntiEntropy[Name](self.sets, self._item_of, _PACE)
        for peer in settings.peers:
            self.accept_peer(peer, float("-inf"))
        self.started_s: float | None = None
        self.is_warm = not self.exchange.peers or ROUTES not in self.sets
        self.answer_paces = TokenBuckets(*ANSWER_BYTES_RATE)
        self.passed_paces = TokenBuckets(*_PASSED_RATE)
        self.revocation_paces = TokenBuckets(*_SENT_RATE)
        self.identities = IdentityChecks()
        self.former = FormerAdvertisers()
        self.now_s = 0.0
        self.refusals: Counter[DropReason] = Counter()
        self.accepted = 0

    def verify_upper(self, statement: Statement, now: Timestamps) -> Membership:
        """Return the signer of a statement from the tier above. Raises ``StatementError``: it is not from there."""
        member = self.policy.verify_sender(statement, now.unix_s)
        if not self.upstream.has(member.name) or member.role is not Role.RIB:
            raise StatementError(DropReason.WRONG_DOMAIN, "not from the tier above")
        statement.verify(member.key)
        if self.upstream.record_alive(member.name, now.mono_s):
            self.upstream_queries.ask_again(now.mono_s)
        return member

    def accept_peer(self, name: Name, now_s: float) -> bool:
        """Add a RIB that proved to be of this domain; return whether it is a peer now."""
        if name not in self.exchange.peers:
            if len(self.exchange.peers) >= PEERS_MAX or name == self.identity.name:
                return False
            self.exchange.add_peer(name, name, now_s)
        return True

    def entry_of(self, key: Key, now_s: float) -> Entry | None:
        """Return the stored entry of an advertiser of a name, for a peer or a snapshot, or None."""
        known = self.store.get(*key)
        return None if known is None else known.to_entry(self.policy.own, now_s)

    def _item_of(self, of: bytes, key: bytes, now_s: float) -> bytes | None:
        """Return an item as a peer gets it, or None."""
        if of == ENDPOINTS:
            return self.endpoints.item_of(Name(key), now_s)
        entry = self.entry_of((Name(key[:NAME_BYTES]), Name(key[NAME_BYTES:])), now_s)
        return None if entry is None else entry.to_cbor()
