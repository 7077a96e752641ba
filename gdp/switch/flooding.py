"""Flooding of link states: one switch's part in keeping all link-state databases equal.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: after RFC 2328, section 13, with these differences.
Neighbours compare digests in every hello and keepalive, and send each other all link states where these differ. So a
lost flood heals without acknowledgements. A switch that has restarted asks not to carry transit until it has learnt the
network again (RFC 6987, stub router on start-up). A leaf passes link states on like any other switch: that keeps
databases equal and attracts no traffic. Its own links stay within its domain.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Final

from gdp.control.hello import DIGEST_BYTES, NodeSettings
from gdp.control.identity_conflicts import IdentityConflicts
from gdp.control.link_state import Adjacency, AttachedRib, LinkState, LinkStateVersion, Scope
from gdp.control.neighbour import Neighbour
from gdp.crypto.certificates import Role
from gdp.crypto.statements import Statement, check_sequence
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import Kind
from gdp.intervals import LINK_STATE
from gdp.limits import LINK_STATE_AGE_MAX_S, LINK_STATES_RATE
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.switch.damping import Damping
from gdp.switch.forwarding_state import ForwardingState
from gdp.token_bucket import TokenBuckets
from gdp.trust.rtcert import RtCertCache

_INCARNATIONS_MAX: Final = 64
_RTCERTS_REMEMBERED: Final = 1_024
# of another incarnation of ours to our link states; a few old ones of a dead incarnation may remain
_ANSWERS: Final = 5
_STUB_S: Final = 2.0  # after a restart, until the trees and paths through here are set up
_STUB_COST: Final = 1 << 20  # above every real path, so only traffic without another path passes
_FLAPPING_COST: Final = 1 << 19  # a flapping link is better than none, and worse than any other
_EARLY_S: Final = 10.0  # when a link state of an earlier incarnation comes this soon, we have restarted
_SYNC_S: Final = 0.5  # between two sends of everything to one neighbour
_OUT_OF_STEP_S: Final = 0.2  # digests differ for less time while a flood is under way


class Flooding:
    """Originates our link states; receives and forwards those of others.

    Args:
        conflicts: nodes that share an identity with another one.

    Attributes:
        is_displaced: an older switch with our identity is alive. This switch then originates nothing more.
    """

    def __init__(self, state: ForwardingState, conflicts: IdentityConflicts, settings: NodeSettings) -> None:
        self._state = state
        self._conflicts = conflicts
        self._sequence = self._first_sequence = settings.first_sequence
        self._incarnation_id = settings.incarnation_id
        self._answers: dict[tuple[bytes, Scope], int] = {}  # by incarnation: how often it exceeded our sequence number
        self.is_displaced = False
        self._conflicts_seen = 0
        self._begun_s: float | None = None
        self._stub_until_s: float | None = None
        self._was_stub = False
        self._domain = state.identity.member.domain
        self._is_leaf = state.identity.role is Role.LEAF
        self.link_states = state.paths.link_states
        self.damping = Damping()
        self._rtcerts = RtCertCache(_RTCERTS_REMEMBERED)
        self._paces = TokenBuckets(*LINK_STATES_RATE)
        self.drops: Counter[DropReason] = Counter()  # RIBs in link states that are rejected
        self._said: dict[Scope, tuple[object, ...]] = {}
        self._refresh_at_s: dict[Scope, float] = {}  # each by itself: news in one scope does not renew the other
        self._synced_s: dict[tuple[int, Name], float] = {}
        self._differs_s: dict[tuple[int, Name], float] = {}  # since when keepalives show other digests

    def receive(self, neighbour: Neighbour, statement: Statement, now: Timestamps) -> bool:
        """Handle a link state that a neighbour passed on; return whether it was news.

        Raises:
            StatementError: it is not valid, or does not belong here.
        """
        if not neighbour.role.is_switch:
            raise StatementError(DropReason.NOT_DELEGATED, "only switches speak of links")
        fields = statement.fields
        version = LinkStateVersion.from_fields(fields)
        if statement.signer != self._state.me:
            if not self.link_states.is_news(statement.signer, version.scope, version.sequence):
                return False
            if self.link_states.is_past(statement.signer, version.scope, version.sequence, version.incarnation_id):
                raise StatementError(DropReason.STALE, "a link state that is over")
            if abs(now.unix_s - version.said_unix_s) > LINK_STATE_AGE_MAX_S:
                raise StatementError(DropReason.STALE, "a link state of another time")
        check_sequence(version.sequence, now.unix_s)
        member = self._state.policy.verify_sender(statement, now.unix_s)
        if not member.role.is_switch:
            raise StatementError(DropReason.BAD_CERTIFICATE, "a link state is signed by a switch")
        is_leaf = member.role is Role.LEAF
        state = LinkState.from_origin(fields, member.name, member.domain, is_leaf=is_leaf)
        if is_leaf and state.scope is Scope.BORDER:
            raise StatementError(DropReason.THROUGH_LEAF, "a leaf that would be a border")
        if state.scope is Scope.DOMAIN and not self._domain == member.domain == neighbour.domain:
            raise StatementError(DropReason.WRONG_DOMAIN, "a link state that should not have left its domain")
        statement.verify(member.key)
        if state.origin == self._state.me:
            self._outdo(state, now.mono_s)
            return False
        if not self._paces.spend(state.origin, now.mono_s):
            raise StatementError(DropReason.QUOTA, "link states of one origin")  # digests bring the last one later
        proven = tuple(rib for rib in state.ribs if self._is_placed(rib, state, now.unix_s))
        if not self.link_states.put(replace(state, ribs=proven), statement.wire, now.mono_s):
            return False
        self._flood(state.scope, statement.wire, but=neighbour)
        return True

    def _is_placed(self, rib: AttachedRib, state: LinkState, unix_s: float) -> bool:
        """Return whether a RIB has proven that it is reachable where a link state lists it.

        A border lists the RIBs of its own domain, and those that are attached to itself. A leaf lists those that are
        both.
        """
        try:
            member = self._state.policy.verify_membership(rib.membership, unix_s)
            rtcert = self._rtcerts.verified(rib.rtcert, member.name, member.key)
            rtcert.validity.check(unix_s, "RtCert")
        except StatementError as error:
            self.drops[error.reason] += 1
            return False
        is_its = (member.role, member.name, member.domain) == (Role.RIB, rib.name, rib.domain)
        is_own = member.domain == state.domain
        is_here = rtcert.switch == state.origin or (state.scope is Scope.BORDER and is_own)
        is_here = is_here and (is_own or not state.is_leaf)
        if not (is_its and is_here):
            self.drops[DropReason.MISPLACED] += 1
        return is_its and is_here

    def tell_of_conflicts(self, now_s: float) -> None:
        """Advertise again which identities this switch refuses, if that changed; cheap otherwise."""
        if self._conflicts_seen != self._conflicts.changes:
            self._originate(now_s)

    def neighbour_changed(self, now_s: float) -> None:
        """Advertise our links again, if they changed."""
        self._originate(now_s)

    def sync(self, neighbour: Neighbour, now_s: float) -> None:
        """Send a neighbour all its link states, but not too often."""
        key = (neighbour.port, neighbour.name)
        if now_s - self._synced_s.get(key, float("-inf")) < _SYNC_S:
            return
        self._synced_s[key] = now_s
        for wire in self.link_states.shared_with(neighbour.domain):
            self._state.outbox.send_to_neighbour(neighbour, Kind.LINK_STATE, wire)

    def is_in_step(self, neighbour: Neighbour) -> bool:
        """Return whether a neighbour's last hello showed the same link states as ours."""
        return neighbour.digest in (self.link_states.digest(neighbour.domain), bytes(DIGEST_BYTES))

    def compare(self, neighbour: Neighbour, now_s: float) -> None:
        """Compare the digest of a neighbour's keepalive; send it our link states where they differ for long."""
        key = (neighbour.port, neighbour.name)
        if self.is_in_step(neighbour):
            self._differs_s.pop(key, None)
        elif now_s - self._differs_s.setdefault(key, now_s) >= _OUT_OF_STEP_S:
            self.sync(neighbour, now_s)

    def handle_timer(self, now_s: float) -> None:
        """Renew our link states, expire those that were not renewed, and follow changes inside our domain."""
        self._begun_s = now_s if self._begun_s is None else self._begun_s
        if self._stub_until_s is not None and now_s >= self._stub_until_s:
            self._stub_until_s = None
        self.link_states.expire(now_s)
        self.damping.expire(now_s)
        for scope, refresh_at_s in self._refresh_at_s.items():
            if now_s >= refresh_at_s:
                self._said.pop(scope, None)
        self._originate(now_s)

    def get_timer(self) -> float:
        """Return the monotonic second of the next timer."""
        times = (
            min(self._refresh_at_s.values(), default=0.0),
            self.link_states.next_expiry(),
            self._stub_until_s,
            self.damping.next_reuse(),
            self._conflicts.next_expiry(),
        )
        return min(time for time in times if time is not None)

    def _originate(self, now_s: float) -> None:
        if self.is_displaced:
            self._refresh_at_s = dict.fromkeys(self._refresh_at_s, now_s + LINK_STATE.refresh_s)
            return
        up = [each for each in self._state.neighbours.all_up() if not self._is_leaf or each.domain == self._domain]
        switches = [each for each in up if each.role.is_switch]
        links = tuple(
            sorted(
                Adjacency(n.name, n.domain, self._cost(n), n.mtu, self._state.neighbours.ports[n.port].link_key(n))
                for n in switches
            )
        )
        self._conflicts_seen = self._conflicts.changes
        ribs = {
            AttachedRib(n.name, n.domain, n.nonce, n.incarnation_id, *n.proof)
            for n in up
            if n.role == Role.RIB and n.proof is not None
        }
        refused = tuple(self._conflicts.refused(now_s))
        self._say(Scope.DOMAIN, links, (), tuple(sorted(ribs)), (), refused, now_s)
        leaving = tuple(link for link in links if link.domain != self._domain)
        if leaving or Scope.BORDER in self._refresh_at_s or self._had_border_state():
            paths = self._state.paths
            inside = tuple(
                Adjacency(border, self._domain, max(distance, 1), 1)
                for border, distance in paths.borders().items()
                if border != self._state.me
            )
            members, ribs_inside = tuple(sorted(paths.members())), tuple(sorted(paths.ribs_inside()))
            self._say(Scope.BORDER, leaving, inside, ribs_inside, members, refused, now_s)

    def _had_border_state(self) -> bool:
        """Return whether others may have a border state of ours, perhaps of an earlier incarnation."""
        return self.link_states.sequence_of(self._state.me, Scope.BORDER) > 0

    def _say(
        self,
        scope: Scope,
        links: tuple[Adjacency, ...],
        inside: tuple[Adjacency, ...],
        ribs: tuple[AttachedRib, ...],
        members: tuple[Name, ...],
        refused: tuple[Name, ...],
        now_s: float,
    ) -> None:
        said = (links, inside, ribs, members, refused)
        if self._said.get(scope) == said:
            return
        self._said[scope] = said
        self._sequence += 1
        now = self._state.now
        state = LinkState(
            origin=self._state.me,
            domain=self._domain,
            scope=scope,
            sequence=self._sequence,
            links=links,
            inside=inside,
            ribs=ribs,
            members=members,
            incarnation_id=self._incarnation_id,
            refused=refused,
            said_unix_s=max(int(now_s + (now.unix_s - now.mono_s)), 0),
            is_leaf=self._is_leaf,
        ).fitted(self._state.identity.membership)
        wire = self._state.identity.signed(state)
        self.link_states.put(state, wire, now_s)
        self._refresh_at_s[scope] = now_s + LINK_STATE.refresh_s
        self._flood(scope, wire)

    def _outdo(self, state: LinkState, now_s: float) -> None:
        """Answer a link state of ours that we did not send: others still have it, or another node has our identity.

        An earlier incarnation's leftover state does not answer. So a sender that exceeds our sequence number repeatedly
        is alive.
        """
        key = state.incarnation_id, state.scope
        if state.incarnation_id != self._incarnation_id and state.sequence > self._sequence:
            if key in self._answers or len(self._answers) < _INCARNATIONS_MAX:
                self._answers[key] = self._answers.get(key, 0) + 1
            if self._answers.get(key, 0) > _ANSWERS:
                self._conflicts.record_clash(self._state.me, now_s, is_proven=True)
                self.is_displaced = self.is_displaced or state.incarnation_id < self._incarnation_id
        is_early = self._begun_s is not None and now_s - self._begun_s < _EARLY_S
        if is_early and not self._was_stub and state.sequence <= self._first_sequence:
            self._was_stub, self._stub_until_s = True, now_s + _STUB_S
            self._originate(now_s)
        if state.sequence > self._sequence:
            self._sequence = state.sequence
            self._said.clear()
            self._originate(now_s)

    def _flood(self, scope: Scope, wire: bytes, but: Neighbour | None = None) -> None:
        for neighbour in self._state.neighbours.all_up():
            is_sender = but is not None and neighbour.port == but.port and neighbour.name == but.name
            is_in_scope = scope is Scope.BORDER or neighbour.domain == self._domain
            if neighbour.role.is_switch and is_in_scope and not is_sender:
                self._state.outbox.send_to_neighbour(neighbour, Kind.LINK_STATE, wire)

    def _cost(self, neighbour: Neighbour) -> int:
        cost = neighbour.cost + (_STUB_COST if self._stub_until_s is not None else 0)
        return cost + (_FLAPPING_COST if self.damping.suppresses((neighbour.port, neighbour.name)) else 0)
