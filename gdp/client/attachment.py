"""How a node that is no switch holds on to the overlay: greet a switch, claim names there, renew, move on.

Place: pure. Whoever publishes, reads or serves builds on this; so does a RIB.

::

    ALONE --a switch is up--> CLAIMING --all claims judged--> ATTACHED
      ^------------- the switch is gone, or another is nearer -----------'
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Final

from gdp.control.frames import ControlJoiner, ControlSplitter
from gdp.control.greeter import Greeter
from gdp.control.join import Join
from gdp.control.neighbour import Neighbour
from gdp.control.presence import Presence
from gdp.control.revocation_sync import RevocationSync
from gdp.control.settings import NodeSettings
from gdp.control.verdict import Verdict
from gdp.control.waiting import Wait, WaitReason, port_waits, stranger_waits
from gdp.crypto.certificates import Role
from gdp.crypto.fields import check_sequence
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, StatementType, parse, sign
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.effects import Arrival, Instant, Transmit
from gdp.errors import DropReason, FrameError, StatementError
from gdp.frame.codec import Header
from gdp.frame.kinds import Kind
from gdp.names import ZERO, Name
from gdp.trust.claim import make_claim
from gdp.trust.domain import Policy
from gdp.trust.revocation import Revocation
from gdp.trust.revocations import hash_of
from gdp.trust.right import HEARS, Right
from gdp.trust.rtcert import RtCert

__all__ = ["Attachment", "Claimed", "attachment_waits"]

_CLAIM_AGAIN_S: Final = 0.5  # until it is judged
_OWN_FIRST_S: Final = 0.5  # that other claims wait for the node's own; without a RIB they are good on this switch only
_MOVED_S: Final = 5.0  # claims name the former switch for so long after a move
_ECHO_S: Final = 0.02  # the greeter answers a new session within this time
_IN_USE_SOON_S: Final = 0.1  # a refused node asks again: its earlier life may be known to be dead any moment
_IN_USE_S: Final = 2.0  # ... and after so long this seldom
_RTCERT_S: Final = 7_200
_RTCERT_RENEW_S: Final = 1_800  # so that it holds at clocks that are an hour ahead, too
_RTCERTS_MAX: Final = 32
_RTCERT_BEFORE_S: Final = 4_500  # it is dated back by so much: CLOCK_EARLY_S is for one clock, this is for the other


@dataclass(slots=True)
class Claimed:
    """A name that this node claims, and what became of it."""

    subject: Subject
    right: Right
    chain: tuple[bytes, ...]
    is_global: bool
    claim_at_s: float = 0.0
    is_taken: bool = False
    refused: DropReason | None = None
    join_sequence: int = -1  # of the newest join for it that came from this switch

    @property
    def is_judged(self) -> bool:
        """Return whether the overlay has said yes or no."""
        return self.is_taken or self.refused is not None


class Attachment:
    """One node's hold on the overlay.

    Args:
        exchange: X25519 key of this life, for notes to what it claims to publish, serve or call; empty: it takes none.
    """

    def __init__(self, identity: Identity, policy: Policy, settings: NodeSettings, exchange: bytes = b"") -> None:
        self._identity = identity
        self._exchange = exchange
        self._policy = policy
        self._incarnation = settings.incarnation
        self._lease_s = settings.lease_s
        self._sequence = settings.first_sequence
        self.started = settings.first_sequence  # above what earlier lives said here, as far as is known
        self.splitter = ControlSplitter(identity.name, settings.incarnation)
        self.joiner = ControlJoiner()
        is_rib = identity.member.role is Role.RIB
        self.greeter = Greeter.of_node(
            identity, policy, self.splitter, settings, rtcert_for=self._rtcert_for if is_rib else None
        )
        self._claims: dict[tuple[Name, Right], Claimed] = {}
        self._switch: Neighbour | None = None
        self._switch_nonce = b""  # of the session with it
        self._last = ZERO  # the switch of the newest attachment, the present one too
        self._former = ZERO  # the one before
        self._moved_s = float("-inf")
        self._rtcerts: dict[Name, tuple[bytes, float]] = {}  # by switch, with the monotonic second of the next one
        self._sync = RevocationSync(identity, policy.revoked, self.greeter, self._say_revoked, settings.first_sequence)
        self._now = Instant(0.0, 0.0)
        self._out: list[Transmit] = []
        self._in_use_s = 0.0  # since when another node with this identity keeps its place
        self.clashes = 0  # signs of another node with this identity
        self.rival_at: Name | None = None  # switch of a newer node with this identity, once it was reported
        self.refusals: Counter[DropReason] = Counter()

    @property
    def switch(self) -> Neighbour | None:
        """Return the switch that this node is attached to, or None."""
        return self._switch

    @property
    def is_attached(self) -> bool:
        """Return whether a switch is there and has judged every claim, and no other node has this identity."""
        is_judged = all(each.is_judged for each in self._claims.values())
        return self._switch is not None and is_judged and not self.is_in_use

    @property
    def is_in_use(self) -> bool:
        """Return whether this node is refused because an older one with its identity is there."""
        own = self._own_claim
        return own is not None and own.refused is DropReason.IN_USE

    @property
    def _own_claim(self) -> Claimed | None:
        return next((each for each in self._claims.values() if each.right is Right.ATTACH), None)

    @property
    def claims(self) -> list[Claimed]:
        """Return what is claimed."""
        return list(self._claims.values())

    @property
    def drops(self) -> Counter[DropReason]:
        """Return which unfinished statements were given up."""
        return self.joiner.drops + self.greeter.drops

    @property
    def mtu(self) -> int:
        """Return the MTU of the port to the switch, in bytes after the Ethernet header."""
        assert self._switch is not None
        return self.greeter.ports[self._switch.port].mtu

    def claim(self, subject: Subject, right: Right, chain: tuple[bytes, ...], *, is_global: bool) -> None:
        """Claim a name from now on."""
        self._claims[subject.name, right] = Claimed(subject, right, chain, is_global)

    def renew(self, name: Name, chain: tuple[bytes, ...]) -> None:
        """Claim what is claimed of a name already by a newer delegation, at once."""
        for (its, _), claimed in self._claims.items():
            if its == name:
                claimed.chain, claimed.claim_at_s, claimed.refused = chain, 0.0, None

    def withdraw(self, name: Name, right: Right) -> None:
        """Claim a name no more, and say so."""
        if self._claims.pop((name, right), None) is not None and self._switch is not None:
            body = {"n": name, "right": right.value, "s": self._next_sequence()}
            wire = sign(StatementType.WITHDRAW, body, self._identity.name, self._identity.key)
            self._say(Kind.WITHDRAW, wire)

    def withdraw_all(self) -> None:
        """Leave: claim nothing any more."""
        for name, right in list(self._claims):
            self.withdraw(name, right)

    def send(self, frames: list[bytes]) -> None:
        """Send frames to the switch; without one they are counted as lost."""
        if self._switch is not None:
            self._out.append(Transmit(self._switch.port, self._switch.mac, frames))
        else:
            self.refusals[DropReason.PORT_DOWN] += len(frames)

    def receive_control(self, arrival: Arrival, header: Header, now: Instant) -> Statement | None:
        """Take a frame of a kind that is for neighbours; return a statement that is for the node above.

        Raises:
            RemoteError: it does not hold.
        """
        if header.kind == Kind.KEEPALIVE:
            self.greeter.receive_keepalive(arrival, header, now)
            return None
        if header.kind == Kind.COOKIE:
            self.greeter.receive_cookie(arrival, header)
            return None
        switch = self._switch
        if header.kind == Kind.HELLO:
            wire = self.greeter.join(arrival, header, now.mono_s)
        elif switch is None or (arrival.port, arrival.mac) != (switch.port, switch.mac):
            raise FrameError(DropReason.UNKNOWN_SENDER, "not our switch")
        else:
            wire = self.joiner.add(header, arrival.frame, now.mono_s, arrival.via)
        if wire is None:
            return None
        statement = parse(wire)
        if header.kind == Kind.HELLO:
            if self.greeter.receive(arrival, statement, now) is not None:
                self._choose_switch(now.mono_s)
            return None
        assert switch is not None  # seen above
        if header.kind == Kind.VERDICT:
            return self._take_verdict(statement, switch, now)
        if header.kind in (Kind.JOIN, Kind.LEAVE):
            join = Join.from_fields(statement.expect(StatementType.JOIN))
            statement.verify(switch.key)
            self.greeter.ports[switch.port].take_join(join, switch)
            self._note_newest(join)
            return statement
        if header.kind == Kind.REVOKE:
            return statement  # it proves itself
        if header.kind == Kind.REVOKED:
            if statement.type is StatementType.REVOKE:
                self._sync.took(switch, hash_of(statement.fields.bytes_("owner")), now.mono_s)
                return statement
            self._sync.receive(switch, statement, now)
            return None
        raise FrameError(DropReason.UNKNOWN_KIND, str(header.kind))

    def take_revocation(self, statement: Statement, now: Instant, holds: Callable[[bytes], bool]) -> Revocation | None:
        """Take a revocation that our switch passed on; return it if it is news.

        Args:
            holds: whether a certificate that a key (33 bytes) issued is held here.

        Raises:
            StatementError: it does not hold, concerns nothing here, or there is no room for it.
        """
        if self._switch is None:
            return None
        revocation = self._policy.revoked.take(statement, self._switch.name, now, holds)
        if revocation is not None:
            self.greeter.recheck(revocation.fingerprint, now)
        return revocation

    def port_changed(self, port: int, up: bool, now: Instant) -> None:
        """Learn that a port's link came or went."""
        self.greeter.port_changed(port, up, now.mono_s)
        self._choose_switch(now.mono_s)

    def timeout(self, now: Instant) -> None:
        """Renew what is due."""
        self._now = now
        if self.greeter.expire(now.mono_s):
            self._choose_switch(now.mono_s)
        self.joiner.expire(now.mono_s)
        self._out += self.greeter.take(now.mono_s)
        self._sync.timeout(now.mono_s)
        if self._switch is None:
            return
        for each in self._due_claims():
            if each.claim_at_s <= now.mono_s:
                each.claim_at_s = now.mono_s + (self._lease_s / 3 if each.is_judged else _CLAIM_AGAIN_S)
                self._say(Kind.ADVERTISE, self._claim_wire(each, now))

    def next_timeout(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [self.greeter.next_timeout(), self._sync.next_timeout()]
        if self._switch is not None:
            times += [each.claim_at_s for each in self._due_claims()]
        return min((time for time in times if time is not None), default=None)

    def _due_claims(self) -> Iterable[Claimed]:
        """Return what may be claimed: while another node has this identity, the node's own name alone."""
        own = self._own_claim
        return (own,) if own is not None and self.is_in_use else self._claims.values()

    def take(self) -> list[Transmit]:
        """Return, once, what is to be sent."""
        out, self._out = self._out, []
        return out

    def _choose_switch(self, now_s: float) -> None:
        """Attach to the switch over the cheapest port; a new or restarted one hears every claim."""
        switches = [each for each in self.greeter.all_up() if each.role.is_switch]
        best = min(switches, key=lambda each: (self.greeter.ports[each.port].cost, each.port), default=None)
        is_same = best is not None and best is self._switch and best.nonce == self._switch_nonce
        if not is_same:
            if self._switch is not None:
                self._sync.neighbour_lost(self._switch)
            if best is not None:
                self._sync.neighbour_up(best, now_s)
        self._switch = best
        self._switch_nonce = b"" if best is None else best.nonce
        if best is not None and not is_same:
            if best.name != self._last:
                self._former, self._last, self._moved_s = self._last, best.name, now_s
            echo_at_s = self.greeter.ports[best.port].hello_at_s
            claim_at_s = echo_at_s if echo_at_s <= now_s + _ECHO_S else now_s  # what comes before our echo is dropped
            for each in self._claims.values():
                # Who hears of a name asks for its node at once: that one is claimed first.
                at_s = claim_at_s if each.right is Right.ATTACH else claim_at_s + _OWN_FIRST_S
                each.claim_at_s, each.is_taken, each.refused, each.join_sequence = at_s, False, None, -1

    def _claim_wire(self, each: Claimed, now: Instant) -> bytes:
        assert self._switch is not None
        return make_claim(
            self._identity,
            each.right,
            each.subject,
            rtcert=self._rtcert_for(self._switch.name),
            sequence=self._next_sequence(),
            incarnation=self._incarnation,
            lease_s=self._lease_s,
            is_global=each.is_global,
            chain=each.chain,
            previous=self._former if now.mono_s - self._moved_s < _MOVED_S else ZERO,
            exchange=self._exchange if each.right in HEARS.values() else b"",
        )

    def _rtcert_for(self, switch: Name) -> bytes:
        """Return the certificate by which this node lets a switch attract its traffic."""
        rtcert, until_s = self._rtcerts.get(switch, (b"", float("-inf")))
        if self._now.mono_s >= until_s:
            unix_s = int(self._now.unix_s)
            rtcert = RtCert.make(self._identity, switch, Validity(unix_s - _RTCERT_BEFORE_S, unix_s + _RTCERT_S))
            self._rtcerts.pop(switch, None)
            self._rtcerts[switch] = rtcert, self._now.mono_s + _RTCERT_RENEW_S
            if len(self._rtcerts) > _RTCERTS_MAX:
                del self._rtcerts[next(iter(self._rtcerts))]
        return rtcert

    def _note_newest(self, join: Join) -> None:
        """Note how new a join is.

        Raises:
            StatementError: REPLAYED: a newer one overtook it, and what it says of the tree is no longer so.
        """
        for right in HEARS.values():
            claimed = self._claims.get((join.topic, right))
            if claimed is None:
                continue
            if join.sequence < claimed.join_sequence:
                raise StatementError(DropReason.REPLAYED, "a newer join overtook it")
            claimed.join_sequence = join.sequence

    def _take_verdict(self, statement: Statement, switch: Neighbour, now: Instant) -> Statement | None:
        """Take what became of a claim, or pass a publisher's place on."""
        fields = statement.fields
        member = self._policy.verify_membership(fields.bytes_("c"), now.unix_s)
        if member.name != statement.signer or (member.name != switch.name and member.role is not Role.RIB):
            raise StatementError(DropReason.BAD_CERTIFICATE, "a verdict from nobody who may judge")
        statement.verify(member.key)
        if statement.type is StatementType.ANSWER:
            return statement
        if statement.type is StatementType.PRESENCE:
            presence = Presence.from_fields(statement.fields)
            if (presence.node, presence.incarnation) == (self._identity.name, self._incarnation):
                self.clashes += 1
                self.rival_at = presence.other
            return None
        verdict = Verdict.from_fields(statement.expect(StatementType.VERDICT))
        check_sequence(verdict.sequence, now.unix_s)
        for (name, _), each in self._claims.items():
            if name == verdict.name and verdict.advertiser == self._identity.name:
                self._judge(each, verdict, now.mono_s)
        return None

    def _judge(self, each: Claimed, verdict: Verdict, now_s: float) -> None:
        if verdict.refused is None:
            if not each.is_taken:
                each.claim_at_s = now_s + self._lease_s / 3
            each.is_taken, each.refused = True, None
            if each.right is Right.ATTACH:
                for other in self._claims.values():
                    if not other.is_judged:
                        other.claim_at_s = min(other.claim_at_s, now_s)
            return
        self.refusals[verdict.refused] += 1
        each.is_taken = False
        if verdict.refused is DropReason.STALE:
            self._sequence = self.started = max(self._sequence, verdict.sequence)
            each.claim_at_s = now_s  # an earlier life of ours was ahead: try again above it
        elif verdict.refused is DropReason.IN_USE and each.right is Right.ATTACH:
            if each.refused is not verdict.refused:
                self._in_use_s = now_s
            each.refused = verdict.refused
            each.claim_at_s = now_s + (_IN_USE_SOON_S if now_s < self._in_use_s + _IN_USE_S else _IN_USE_S)
            self.clashes += 1
        else:
            each.refused = verdict.refused
            each.claim_at_s = now_s + self._lease_s / 3  # it may be taken later, but not for asking often

    def _say_revoked(self, neighbour: Neighbour, wire: bytes) -> None:
        if neighbour is self._switch:
            self._say(Kind.REVOKED, wire)

    def _say(self, kind: Kind, wire: bytes) -> None:
        assert self._switch is not None
        self.send(self.splitter.split(kind, wire, self.mtu))

    def _next_sequence(self) -> int:
        self._sequence += 1
        return self._sequence


def attachment_waits(attachment: Attachment, now_s: float) -> list[Wait]:
    """Return what keeps a node from being attached with all it advertises; empty when nothing does."""
    if attachment.switch is None:
        ports = attachment.greeter.ports.values()
        of_ports = [wait for port in ports for wait in port_waits(port, (Role.SWITCH, Role.LEAF))]
        strangers = list(stranger_waits(attachment.greeter, now_s))
        refusing = {wait.port for wait in strangers}
        return [*strangers, *(w for w in of_ports if w.port not in refusing or w.reason is WaitReason.LINK_DOWN)]
    return list(_claim_waits(attachment))


def _claim_waits(attachment: Attachment) -> Iterator[Wait]:
    claims = attachment.claims
    if attachment.is_in_use:
        yield Wait(WaitReason.IN_USE)
        return
    if any(not each.is_judged for each in claims):
        yield Wait(WaitReason.NO_RIB)
    for each in claims:
        if each.refused is not None:
            yield Wait(WaitReason.REFUSED, name=each.subject.name, refused=each.refused)
