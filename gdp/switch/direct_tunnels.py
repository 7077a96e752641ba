"""Direct tunnels: to which switches behind NATs this switch opens one, and which candidates it tries when.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: ICE (RFC 8445, sections 6.1.2 and 6.1.4) for pairs of
candidates and their checks, with WireGuard's handshake as the check. Both ends know both records, so they derive the
same list of pairs, try each pair for the same time, and draw the same pauses between rounds. They start when the newer
of the two records arrives, which is nearly at once at both: each end's packets open its NAT for those of the other.

A NAT that accepts packets itself (Linux with an open ``input`` chain) remembers those of a peer that came before the
own ones left, and maps these to another port as long as it does: conntrack's 30 s after the last. So after some rounds
both ends fall silent for longer, and then start by chance up to half a second apart.

WireGuard sends replies to where a valid packet came from. So it suffices that one end reaches the other, and that the
other has its peer configured: a peer stays configured in all pauses, until ``Close``.

Types of candidates are tried in this order, of which each end takes the other's::

    host       private IPv4 (RFC 1918, RFC 6598), where both are in one network or behind one NAT
    IPv6       addresses of devices, without a NAT
    reflexive  as a border sees it, or a public IPv4 of a device; a NAT is opened unless its mapping depends on the
               destination
    public     stated by an operator
"""

from __future__ import annotations

import hashlib
import ipaddress
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import product
from typing import Final, NamedTuple

from gdp.control.endpoints import Candidate, CandidateType, EndpointRecord
from gdp.control.tunnel_plan import DIAL_S
from gdp.intervals import Rate
from gdp.limits import DIRECT_TUNNELS_MAX
from gdp.names import Name
from gdp.requests import Backoff
from gdp.token_bucket import TokenBuckets

_PAIRS_MAX: Final = 4  # of one type
_ROUNDS_AT_ONCE: Final = 3  # before the first pause: the first packet of one end opens its NAT for the other's second
_PAUSES: Final = Backoff(2.0, 60.0)  # by rounds
_JITTER: Final = 0.25  # of a pause, up or down
_SILENT_FROM: Final = 3  # the fourth pause, and later ones, are silent
_SILENCE_S: Final = 32.0  # longer than nf_conntrack_udp_timeout, 30 s
_MOVED_S: Final = 5.0  # after a change of a record: an end has moved
_HOLD_S: Final = 2.5  # after a handshake, for the hello protocol
_OPENS_RATE: Final = Rate(0.1, burst=8.0)  # of one peer's tunnel: each makes devices
_REDUNDANT_S: Final = 30.0  # a tunnel next to a local link is closed after this time
_IPV4_PRIVATE_BITS: Final = 16  # two private addresses with this prefix may be in one network


class Open(NamedTuple):
    """Configure the peer of a record and try a candidate; None: wait for the peer's packets.

    Args:
        record: of the peer. The key of the tunnel is that of the candidate's uplink, or of ``peer_uplink``.
        candidate: the peer's endpoint to send to.
        uplink: our own uplink, numbered from 0.
        peer_uplink: the peer's uplink, numbered from 0.
    """

    record: EndpointRecord
    candidate: Candidate | None
    uplink: int = 0
    peer_uplink: int = 0


class Retry(NamedTuple):
    """Send a handshake to another candidate, or to the same once more; None: only configure this pair of uplinks.

    Pairs of uplinks that were tried before stay configured until ``Close``. WireGuard repeats a handshake to a peer
    after 5 s at the earliest, so that the peer must be replaced. That ends its session: report a completed handshake by
    ``DirectTunnels.answered``, which delays the next attempt. Arguments as in ``Open``.
    """

    record: EndpointRecord
    candidate: Candidate | None
    uplink: int = 0
    peer_uplink: int = 0


class Silence(NamedTuple):
    """Send nothing to the peer of a record any more; it stays configured, and what it sends is answered."""

    record: EndpointRecord


class Close(NamedTuple):
    """Remove the peer of this name, and its port."""

    name: Name


Action = Open | Retry | Silence | Close


class _Class(IntEnum):
    """Order in which candidates are tried."""

    HOST = 0
    IPV6 = 1
    REFLEXIVE = 2
    PUBLIC = 3


class Slot(NamedTuple):
    """One attempt, as one end sees it: over which uplinks, and the candidate that it sends to, if any."""

    uplink: int
    peer_uplink: int
    candidate: Candidate | None


def slots_between(own: EndpointRecord, peer: EndpointRecord) -> list[Slot]:
    """Return the attempts of a round; those at the other end are of the same number, order and uplinks."""
    is_first = own.name < peer.name
    first, second = (own, peer) if is_first else (peer, own)
    slots: list[Slot] = []
    for class_ in _Class:
        for a, b in _pairs(class_, first, second):
            ours, theirs = (a, b) if is_first else (b, a)
            slots.append(Slot(ours[0], theirs[0], theirs[1]))
    return slots


_End = tuple[int, Candidate | None]  # uplink, and a candidate of it


def _pairs(class_: _Class, first: EndpointRecord, second: EndpointRecord) -> list[tuple[_End, _End]]:
    """Return the pairs of one class; where one end has no candidate, each of its uplinks tries those of the other."""
    ends: list[list[_End]] = []
    for record in (first, second):
        found = {(each.uplink, each.endpoint): each for each in record.candidates if _class_of(each) is class_}
        ends.append([(each.uplink, each) for each in found.values()])
    if not ends[0] and not ends[1]:
        return []
    if class_ in (_Class.HOST, _Class.IPV6):
        pairs = [(a, b) for a, b in product(*ends) if _is_matched(class_, (a[1], b[1]), (first, second))]
    else:
        idle: list[list[_End]] = [[(uplink, None) for uplink in range(len(each.keys))] for each in (first, second)]
        pairs = list(product(ends[0] or idle[0], ends[1] or idle[1]))
    return pairs[:_PAIRS_MAX]


def _class_of(candidate: Candidate) -> _Class | None:
    address = ipaddress.ip_address(candidate.endpoint.address)
    if (
        candidate.type is CandidateType.RELAY_TLS
        or address.is_link_local
        or address.is_loopback
        or address.is_multicast
        or address.is_unspecified
    ):
        return None
    if candidate.type is CandidateType.PUBLIC:
        return _Class.PUBLIC
    if address.version == 6:
        return _Class.IPV6
    is_host = candidate.type is CandidateType.HOST and candidate.endpoint.is_private
    return _Class.HOST if is_host else _Class.REFLEXIVE


def _is_matched(
    class_: _Class,
    candidates: tuple[Candidate | None, Candidate | None],
    records: tuple[EndpointRecord, EndpointRecord],
) -> bool:
    one, other = (ipaddress.ip_address(each.endpoint.address) for each in candidates if each is not None)
    if class_ is _Class.IPV6:
        return (one in _UNIQUE_LOCAL) is (other in _UNIQUE_LOCAL)
    if one == other:
        return False  # of a device that only its machine reaches, such as a bridge of containers
    ours, theirs = (
        {each.endpoint.address for each in record.candidates if _class_of(each) is _Class.REFLEXIVE}
        for record in records
    )
    shift = one.max_prefixlen - _IPV4_PRIVATE_BITS
    return int(one) >> shift == int(other) >> shift or bool(ours & theirs)


_UNIQUE_LOCAL: Final = ipaddress.ip_network("fc00::/7")  # RFC 4193


@dataclass(slots=True, kw_only=True)
class _Attempt:
    """State of the tunnel to one peer."""

    record: EndpointRecord
    slots: list[Slot]
    due_s: float  # of the next action
    silent_s: float = float("inf")  # when a silence begins
    stagger_s: float = 0.0  # by how much the present round is late
    at: int = 0  # slot that is due
    round: int = 0
    configured: set[tuple[int, int]] = field(default_factory=set)  # pairs of uplinks
    is_up: bool = False
    changed_s: float = float("-inf")  # when either record changed
    linked_s: float | None = None  # since when there is another link to the peer


class DirectTunnels:
    """Decision which direct tunnels are open.

    Args:
        me: the name of this switch.
        maximum: number of tunnels at once.
    """

    def __init__(self, me: Name, maximum: int = DIRECT_TUNNELS_MAX) -> None:
        self._me = me
        self._maximum = maximum
        self._attempts: dict[Name, _Attempt] = {}
        self._own: EndpointRecord | None = None
        self._ranks: dict[Name, bytes] = {}  # of the members at the last call of ``peers``
        self._opens = TokenBuckets(*_OPENS_RATE)

    def peers(self, members: Iterable[Name], linked: Collection[Name]) -> list[Name]:
        """Return the switches whose records are of use, the most preferred first.

        Those with a tunnel stay, also while no path leads to them. Of the others each pair has a rank that both ends
        compute, so that with more than ``maximum`` members both ends tend to choose each other.
        """
        others = {each for each in members if each != self._me and each not in linked} - self._attempts.keys()
        self._ranks = {name: self._rank(name) for name in others}
        return [*self._attempts, *sorted(others, key=self._ranks.__getitem__)]

    def poll_actions(
        self,
        *,
        own: EndpointRecord | None,
        records: Mapping[Name, EndpointRecord],
        linked: Collection[Name],
        up: Collection[Name],
        now_s: float,
    ) -> list[Action]:
        """Return the actions that are due, in order.

        Args:
            own: this switch's record; None: all tunnels are closed.
            records: valid records of other switches.
            linked: switches with another link than a direct tunnel, up or configured.
            up: switches that are neighbours over their direct tunnel.
            now_s: monotonic second.
        """
        actions: list[Action] = []
        has_changed = own is not None and (self._own is None or not _is_same(own, self._own))
        self._own = own
        for name in list(self._attempts):
            attempt = self._attempts[name]
            if own is None or (name not in records and not (attempt.is_up and name in up)):
                actions += self._close(name)
                continue
            self._update(attempt, own, records.get(name, attempt.record), actions, now_s, has_changed=has_changed)
            self._watch(attempt, now_s, is_up=name in up, is_linked=name in linked)
            is_redundant = attempt.linked_s is not None and (
                not attempt.is_up or now_s - attempt.linked_s >= _REDUNDANT_S
            )
            if is_redundant or (not attempt.slots and not attempt.is_up):
                actions += self._close(name)
        if own is not None:
            self._begin(own, records, linked, now_s)
        for attempt in self._attempts.values():
            actions += self._attempt(attempt, now_s)
        return actions

    def answered(self, name: Name, now_s: float) -> None:
        """Record that WireGuard completed a handshake with a peer: the present candidate is given time to come up."""
        attempt = self._attempts.get(name)
        if attempt is not None and not attempt.is_up:
            attempt.due_s = max(attempt.due_s, now_s + _HOLD_S)
            attempt.silent_s = float("inf")

    def failure(self, name: Name) -> str:
        """Return why the tunnel to a peer is not up, as far as known; empty: it is up, or too young to say."""
        attempt = self._attempts.get(name)
        if attempt is None or attempt.is_up or attempt.round < _ROUNDS_AT_ONCE:
            return ""
        sent = any(each.candidate is not None for each in attempt.slots)
        what = "no answer from its endpoints" if sent else "it has no endpoint that can be reached, and sends nothing"
        return f"{what} in {attempt.round} rounds: a NAT or firewall on the way is closed, or maps to other ports"

    def _update(
        self,
        attempt: _Attempt,
        own: EndpointRecord,
        record: EndpointRecord,
        actions: list[Action],
        now_s: float,
        *,
        has_changed: bool,
    ) -> None:
        """Begin again if either record has changed; a tunnel that is up stays, unless the peer has another key."""
        is_rekeyed = record.keys != attempt.record.keys
        if is_rekeyed and not self._opens.spend(record.name, now_s):
            record, is_rekeyed = attempt.record, False  # the new one counts later
        is_changed = has_changed or not _is_same(record, attempt.record)
        attempt.record = record
        if not is_changed:
            return
        attempt.slots, attempt.changed_s = slots_between(own, record), now_s
        if is_rekeyed and attempt.configured:
            actions.append(Close(record.name))
            attempt.configured.clear()
            attempt.is_up = False
        if not attempt.is_up:
            attempt.due_s, attempt.at, attempt.round = now_s, 0, 0
            attempt.silent_s, attempt.stagger_s = float("inf"), 0.0

    @staticmethod
    def _watch(attempt: _Attempt, now_s: float, *, is_up: bool, is_linked: bool) -> None:
        if attempt.is_up and not is_up:
            # it may recover by itself, for WireGuard follows a peer that moves, but not if an end has just moved
            wait_s = 0.0 if now_s - attempt.changed_s <= _MOVED_S else DIAL_S
            attempt.due_s, attempt.at, attempt.round, attempt.stagger_s = now_s + wait_s, 0, 0, 0.0
        attempt.is_up = is_up and bool(attempt.configured)
        if attempt.is_up:
            attempt.silent_s = float("inf")
        if not is_linked:
            attempt.linked_s = None
        elif attempt.linked_s is None:
            attempt.linked_s = now_s

    def _begin(
        self, own: EndpointRecord, records: Mapping[Name, EndpointRecord], linked: Collection[Name], now_s: float
    ) -> None:
        for name in sorted(records.keys() - self._attempts.keys() - {self._me}, key=self._rank):
            if len(self._attempts) >= self._maximum:
                return
            slots = slots_between(own, records[name])
            if slots and name not in linked and self._opens.spend(name, now_s):
                self._attempts[name] = _Attempt(record=records[name], slots=slots, due_s=now_s)

    def _attempt(self, attempt: _Attempt, now_s: float) -> list[Action]:
        """Return the action of the slot that is due now; slots that this node was too late for are left out."""
        if now_s >= attempt.silent_s:
            attempt.silent_s = float("inf")
            return [Silence(attempt.record)]
        if attempt.is_up or now_s < attempt.due_s:
            return []
        slot = attempt.slots[attempt.at]
        while attempt.due_s <= now_s:
            slot = attempt.slots[attempt.at]
            attempt.due_s += DIAL_S
            attempt.at += 1
            if attempt.at == len(attempt.slots):
                pause_s = self._pause_s(attempt.record.name, attempt.round)
                if pause_s >= _SILENCE_S and any(each.candidate is not None for each in attempt.slots):
                    attempt.silent_s = attempt.due_s
                attempt.due_s += pause_s - attempt.stagger_s
                attempt.stagger_s = self._stagger_s(attempt.record.name, pause_s)
                attempt.due_s += attempt.stagger_s
                attempt.at, attempt.round = 0, attempt.round + 1
        pair = slot.uplink, slot.peer_uplink
        make = Retry if attempt.configured else Open
        has_effect = slot.candidate is not None or pair not in attempt.configured
        attempt.configured.add(pair)
        return [make(attempt.record, slot.candidate, *pair)] if has_effect else []

    def _close(self, name: Name) -> list[Action]:
        return [Close(name)] if self._attempts.pop(name).configured else []

    def _pause_s(self, peer: Name, round_: int) -> float:
        """Return the pause after a round, the same at both ends."""
        doublings = round_ + 1 - _ROUNDS_AT_ONCE
        if doublings < 0:
            return 0.0
        draw = int.from_bytes(self._hash(peer, round_.to_bytes(4, "big"))[:4], "big") / (1 << 32)
        pause_s = _PAUSES.pause_s(doublings + 1)
        pause_s *= 1 - _JITTER + 2 * _JITTER * draw
        return max(pause_s, _SILENCE_S * (1 + _JITTER * draw)) if doublings >= _SILENT_FROM else pause_s

    def _stagger_s(self, peer: Name, pause_s: float) -> float:
        """Return by how much this end starts later after a silence, not the same at both ends."""
        if pause_s < _SILENCE_S:
            return 0.0
        draw = hashlib.sha256(self._me + self._hash(peer, str(pause_s).encode())).digest()[0] / 256
        return max(0.0, 2 * draw - 1) * DIAL_S / 2  # in half of the rounds there is none

    def _rank(self, peer: Name) -> bytes:
        return self._ranks.get(peer) or self._hash(peer, b"rank")

    def _hash(self, peer: Name, about: bytes) -> bytes:
        return hashlib.sha256(b"gdp direct tunnel\0" + min(self._me, peer) + max(self._me, peer) + about).digest()


def _is_same(one: EndpointRecord, other: EndpointRecord) -> bool:
    """Return whether two records of a switch differ in sequence and time only."""
    return (one.keys, one.candidates) == (other.keys, other.candidates)
