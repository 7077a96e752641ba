"""Attachment of a node that is no switch: discovers a switch, advertises names there, renews them, and changes switch.

Sans-I/O. A participant builds on this, and so does a RIB.

::

    ALONE --a switch is up--> ADVERTISING --all acknowledged--> ATTACHED
      ^------------- the switch is gone, or another is nearer -----------'
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final, TypeAlias

from gdp.control.diagnostic_bodies import RightEvidence
from gdp.control.fragments import ControlFragmenter, ControlReassembler
from gdp.control.hello import NodeSettings
from gdp.control.hello_port import TWO_HELLOS_S
from gdp.control.join import Join, JoinRefresh
from gdp.control.neighbour import Neighbour
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.control.pace import ReaderPace
from gdp.control.presence import Presence
from gdp.control.revocation_sync import RevocationSync
from gdp.control.rib_statements import AdvertiseAck
from gdp.control.waiting import Wait, WaitReason, port_waits, stranger_waits
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, StatementType, check_sequence, parse
from gdp.crypto.subject import Subject
from gdp.crypto.validity import Validity
from gdp.due_queue import earliest
from gdp.errors import DropReason, FrameError, StatementError
from gdp.frame.codec import Header, Kind
from gdp.intervals import SoftState, renew_after_s
from gdp.limits import CLOCK_SKEW_S
from gdp.names import ZERO, Name
from gdp.requests import Backoff, Requests
from gdp.sansio import OutgoingFrames, ReceivedFrame, Timestamps, new_tuple
from gdp.trust.advertisement import MS, UnverifiedAdvertisement, Withdrawal
from gdp.trust.domain import Policy
from gdp.trust.revocation import Revocation
from gdp.trust.right import HEARS, Right
from gdp.trust.rtcert import RtCert

_FIRST_S: Final = 0.5  # until the first acknowledgement
_FIRST: Final = Backoff(_FIRST_S, _FIRST_S)
_RENEWAL_AGAIN: Final = 1 / 12  # of a lease: a renewal has some five frames, and is lost with any of them
_MOVED_S: Final = 5.0  # after a move, advertisements name the former switch for this time
_IN_USE_SOON_S: Final = 0.1  # a refused node tries again: its earlier incarnation may prove ended at any moment
_IN_USE_S: Final = 2.0  # ... and after this time with this interval
_RTCERT: Final = SoftState(1_800, periods=4)  # so that it is valid at clocks that are an hour ahead, too
_RTCERTS_MAX: Final = 32
_Key: TypeAlias = tuple[Name, Right]


@dataclass(slots=True, kw_only=True)
class PendingAdvertisement:
    """A name that this node advertises, and the state of its acknowledgement."""

    subject: Subject
    right: Right
    chain: tuple[bytes, ...]
    is_global: bool
    paths: int = 1
    is_session: bool = False
    wants_costs: bool = False
    is_taken: bool = False
    refused: DropReason | None = None
    sent_sequence: int = 0  # of the newest advertisement that was sent
    join_sequence: int = -1  # of the newest join for it that came from this switch
    joins: dict[int, Join] = field(default_factory=dict)  # the newest from this switch, by path

    @property
    def is_acknowledged(self) -> bool:
        """Return whether the overlay has accepted or rejected it."""
        return self.is_taken or self.refused is not None

    @property
    def key(self) -> _Key:
        """Return the name and the right, of which a node makes one advertisement."""
        return self.subject.name, self.right


class Attachment:
    """Attachment of one node to the overlay.

    Args:
        exchange: X25519 key of this incarnation, for control datagrams about the names that it advertises to publish,
            serve or call; empty: it accepts none.

    Attributes:
        switch: that this node is attached to; None: there is none.
        outgoing: the frames to send next.
        started: number above those of earlier incarnations here, as far as known.
        clashes: signs of another node with this identity.
        conflict_at: switch of a newer node with this identity, once it was reported.
    """

    def __init__(self, identity: Identity, policy: Policy, settings: NodeSettings, exchange: bytes = b"") -> None:
        self._identity = identity
        self._exchange = exchange
        self._policy = policy
        self._incarnation = settings.incarnation
        self._lease_s = settings.lease_s
        first_s = min(_FIRST_S, _RENEWAL_AGAIN * settings.lease_s)
        self._renewals = Backoff(first_s, renew_after_s(settings.lease_s))
        self._sequence = settings.first_sequence
        self.started = settings.first_sequence
        self.fragmenter = ControlFragmenter(identity.name, settings.incarnation)
        self.reassembler = ControlReassembler()
        self._rtcerts: dict[Name, tuple[bytes, float]] = {}  # by switch, with the monotonic second of the next one
        self._now = Timestamps(0.0, 0.0)
        is_rib = identity.member.role is Role.RIB
        self.hello_protocol = HelloProtocol(
            identity, policy, self.fragmenter, settings, rtcert_for=self._rtcert_for if is_rib else None
        )
        self._advertisements: dict[_Key, PendingAdvertisement] = {}
        self._requests = Requests[_Key]()
        self._own: PendingAdvertisement | None = None  # of the node's own name
        self.switch: Neighbour | None = None
        self._switch_nonce = b""  # of the session with it
        self._last = ZERO  # the switch of the newest attachment, the present one too
        self._former = ZERO  # the one before
        self._moved_s = float("-inf")
        self._sync = RevocationSync(
            identity,
            policy.revoked,
            self.hello_protocol.neighbours,
            lambda to, wire: self.say(Kind.REVOKED, wire) if to is self.switch else None,
            settings.first_sequence,
        )
        self.outgoing: list[OutgoingFrames] = []
        self._in_use_s = 0.0  # since when another node with this identity is accepted instead
        self.clashes = 0
        self.conflict_at: Name | None = None
        self.refusals: Counter[DropReason] = Counter()

    @property
    def is_attached(self) -> bool:
        """Return whether a switch has acknowledged every advertisement, and no other node has this identity."""
        is_judged = all(each.is_acknowledged for each in self._advertisements.values())
        return self.switch is not None and is_judged and not self.is_in_use

    @property
    def is_in_use(self) -> bool:
        """Return whether this node is refused because an older one with its identity is there."""
        return self._own is not None and self._own.refused is DropReason.IN_USE

    @property
    def is_revoked(self) -> bool:
        """Return whether the membership of this node is revoked, as far as it has learnt."""
        member = self._identity.member
        return self._policy.revoked.has(member.fingerprint, member.issuer_key)

    @property
    def advertisements(self) -> list[PendingAdvertisement]:
        """Return the present advertisements."""
        return list(self._advertisements.values())

    @property
    def drops(self) -> Counter[DropReason]:
        """Return the unfinished statements that were given up, by reason."""
        return self.reassembler.drops + self.hello_protocol.drops

    def advertisement(
        self,
        subject: Subject,
        right: Right,
        chain: tuple[bytes, ...],
        *,
        is_global: bool,
        paths: int = 1,
        is_session: bool = False,
    ) -> None:
        """Advertise a name from now on.

        Args:
            paths: over how many disjoint paths its frames are to travel.
            is_session: a session secret may authenticate its unicast streams.
        """
        each = PendingAdvertisement(
            subject=subject, right=right, chain=chain, is_global=is_global, paths=paths, is_session=is_session
        )
        self._advertisements[each.key] = each
        self._requests.start(each.key, 0.0)
        if right is Right.ATTACH:
            self._own = each

    def evidence_of(self, name: Name) -> dict[str, object]:
        """Return the fields that show this node's right on a name that it advertises; empty if it does not."""
        for (its, right), each in self._advertisements.items():
            if its == name:
                return RightEvidence(each.subject, right, tuple(each.chain)).to_fields()
        return {}

    def renew(self, name: Name, chain: tuple[bytes, ...]) -> None:
        """Replace the delegation of an advertised name by a newer one, and advertise it at once."""
        for (its, _), each in self._advertisements.items():
            if its == name:
                each.chain, each.refused = chain, None
                self._requests.hasten(each.key, 0.0)

    def request_costs(self, name: Name, right: Right) -> None:
        """Have the switch state the costs of the paths to those that this node hears on a name, from now on."""
        each = self._advertisements.get((name, right))
        if each is not None and not each.wants_costs:
            each.wants_costs = True
            self._requests.hasten(each.key, 0.0)

    def withdraw(self, name: Name, right: Right) -> None:
        """Stop advertising a name, and send the withdrawal."""
        self._requests.cancel((name, right))
        if self._advertisements.pop((name, right), None) is not None and self.switch is not None:
            withdrawal = Withdrawal(name, right, self._next_sequence())
            self.say(Kind.WITHDRAW, withdrawal.to_wire(self._identity.name, self._identity.key))

    def withdraw_all(self) -> None:
        """Leave: withdraw every advertisement."""
        self._own = None
        for name, right in list(self._advertisements):
            self.withdraw(name, right)

    def send(self, frames: list[bytes]) -> None:
        """Send frames to the switch; without one they are counted as lost."""
        if self.switch is not None:
            self.outgoing.append(new_tuple(OutgoingFrames, (self.switch.port, self.switch.mac, frames)))
        else:
            self.refusals[DropReason.PORT_DOWN] += len(frames)

    def receive_control(self, arrival: ReceivedFrame, header: Header, now: Timestamps) -> Statement | None:
        """Process a frame of a kind that is for neighbours; return a statement that is for the node above.

        Raises:
            RemoteError: the frame or its statement is invalid.
        """
        if header.kind == Kind.KEEPALIVE:
            self.hello_protocol.receive_keepalive(arrival, header, now)
            return None
        if header.kind == Kind.COOKIE:
            self.hello_protocol.receive_cookie(arrival, header)
            return None
        switch = self.switch
        if header.kind == Kind.HELLO:
            wire = self.hello_protocol.reception.join(arrival, header, now.mono_s)
        elif switch is None or (arrival.port, arrival.mac) != (switch.port, switch.mac):
            raise FrameError(DropReason.UNKNOWN_SENDER, "not our switch")
        else:
            wire = self.reassembler.add(header, arrival.frame, now.mono_s, arrival.via)
        if wire is None:
            return None
        statement = parse(wire)
        if header.kind == Kind.HELLO:
            if self.hello_protocol.receive(arrival, statement, now) is not None:
                self.outgoing += self.hello_protocol.hellos_to_send(now.mono_s)  # ahead of all else
                self._choose_switch(now.mono_s)
            return None
        assert switch is not None  # checked above
        if header.kind == Kind.ADVERTISE_ACK:
            return self._handle_ack(statement, switch, now)
        if header.kind in (Kind.JOIN, Kind.LEAVE):
            join = Join.from_fields(statement.expect(StatementType.JOIN))
            statement.verify(switch.key)
            self.hello_protocol.ports[switch.port].receive_join(join, switch)
            self._note_newest(join)
            return statement
        if header.kind == Kind.JOIN_REFRESH:
            statement.expect(StatementType.JOIN_REFRESH)
            statement.verify(switch.key)
            return statement
        if header.kind == Kind.REVOKE:
            return statement  # it proves itself
        if header.kind == Kind.REVOKED:
            if statement.type is StatementType.REVOKE:
                self._sync.took(switch, now.mono_s)
                return statement
            self._sync.receive(switch, statement, now)
            return None
        raise FrameError(DropReason.UNKNOWN_KIND, str(header.kind))

    def receive_revocation(
        self, statement: Statement, now: Timestamps, holds: Callable[[bytes], bool]
    ) -> Revocation | None:
        """Process a revocation that our switch forwarded; return it if it is new.

        Args:
            holds: whether another certificate that a key (33 bytes) issued is held here than those of own delegations.

        Raises:
            StatementError: it is invalid, concerns nothing here, or the store of its issuer is full.
        """
        if self.switch is None:
            return None
        owners = {each.subject.owner_key for each in self._advertisements.values()}
        revocation = self._policy.revoked.receive_revocation(
            statement, self.switch.name, now, lambda key: key in owners or holds(key)
        )
        if revocation is not None:
            self.hello_protocol.recheck(revocation.fingerprint, now)
        return revocation

    def refreshed_joins(self, statement: Statement) -> list[Join]:
        """Return the joins that a verified refresh of our switch renews; the switch hears which are unknown.

        Raises:
            StatementError: MALFORMED, or REPLAYED.
        """
        switch, refresh = self.switch, JoinRefresh.from_fields(statement.fields)
        if refresh.is_reply:
            raise StatementError(DropReason.MALFORMED, "an attached node refreshes no joins")
        if switch is None:
            return []
        port = self.hello_protocol.ports[switch.port]
        port.receive_join(refresh, switch)
        known = {join.sequence: join for each in self._advertisements.values() for join in each.joins.values()}
        unknown = tuple(number for number in refresh.numbers if number not in known)
        if unknown:
            reply = JoinRefresh(
                numbers=unknown,
                session=switch.echo,
                sender_session=port.nonce,
                sequence=self._next_sequence(),
                is_reply=True,
            )
            self.say(Kind.JOIN_REFRESH, reply.to_wire(self._identity.name, self._identity.key))
        return [known[number] for number in refresh.numbers if number in known]

    def state_pace(self, topic: Name, publisher: Name, pace: int) -> None:
        """State to the switch which messages of a publisher it is to send here."""
        if (switch := self.switch) is not None:
            nonce = self.hello_protocol.ports[switch.port].nonce
            body = ReaderPace(
                topic=topic, publisher=publisher, pace=pace, session=switch.echo, sender_session=nonce,
                sequence=self._next_sequence(),
            )  # fmt: skip
            self.say(Kind.PACE, body.to_wire(self._identity.name, self._identity.key))

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        """Update the state of a port's link."""
        self.hello_protocol.port_changed(port, up, now.mono_s)
        self._choose_switch(now.mono_s)

    def handle_timer(self, now: Timestamps) -> None:
        """Send the hellos, renewals and repetitions that are due."""
        self._now = now
        if self.hello_protocol.drop_silent(now.mono_s):
            self._choose_switch(now.mono_s)
        self.reassembler.drop_expired(now.mono_s)
        self.outgoing += self.hello_protocol.hellos_to_send(now.mono_s)
        self._sync.handle_timer(now.mono_s)
        if self.switch is None:
            return
        due = self._poll_due(now.mono_s)
        for key in [key for key in self._advertisements if key in due]:  # the node's own name first
            each = self._advertisements[key]
            self._requests.sent(key, now.mono_s, self._renewals if each.is_acknowledged else _FIRST)
            self.say(Kind.ADVERTISE, self._advertisement_wire(each, now))
            each.sent_sequence = self._sequence

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        if self.switch is None:
            due_s = None
        elif self._own is not None and self.is_in_use:
            due_s = self._requests.due_s(self._own.key)
        else:
            due_s = self._requests.next_due()
        return earliest(self.hello_protocol.get_timer(), self._sync.get_timer(), due_s)

    def _poll_due(self, now_s: float) -> list[_Key]:
        """Return the advertisements to send now: only the node's own name while another has this identity."""
        if self._own is None or not self.is_in_use:
            return self._requests.poll_due(now_s)
        return [self._own.key] if self._requests.due_s(self._own.key) <= now_s else []

    def _choose_switch(self, now_s: float) -> None:
        """Attach to the switch over the cheapest link; a new or restarted one receives every advertisement."""
        switches = [each for each in self.hello_protocol.neighbours.all_up() if each.role.is_switch]
        best = min(switches, key=lambda each: (each.cost, each.port), default=None)
        is_same = best is not None and best is self.switch and best.nonce == self._switch_nonce
        if not is_same:
            if self.switch is not None:
                self._sync.neighbour_lost(self.switch)
            if best is not None:
                self._sync.neighbour_up(best, now_s)
        self.switch = best
        self._switch_nonce = b"" if best is None else best.nonce
        if best is not None and not is_same:
            if best.name != self._last:
                self._former, self._last, self._moved_s = self._last, best.name, now_s
            echo_at_s = self.hello_protocol.ports[best.port].hello_at_s
            # frames before our echo are dropped
            advertisement_at_s = echo_at_s if echo_at_s <= now_s + TWO_HELLOS_S else now_s
            for each in self._advertisements.values():
                # A node that learns of a name queries its advertiser at once, so the node's own name is advertised
                # first. Without a RIB the others are valid on this switch only.
                is_own = each.right is Right.ATTACH
                self._requests.start(each.key, advertisement_at_s if is_own else advertisement_at_s + _FIRST_S)
                each.is_taken, each.refused, each.join_sequence = False, None, -1
                each.joins.clear()

    def _advertisement_wire(self, each: PendingAdvertisement, now: Timestamps) -> bytes:
        assert self.switch is not None
        advertisement = UnverifiedAdvertisement(
            subject=each.subject,
            right=each.right,
            rtcert=self._rtcert_for(self.switch.name),
            sequence=self._next_sequence(),
            incarnation=self._incarnation,
            lease_ms=round(self._lease_s * MS),
            is_global=each.is_global,
            chain=each.chain,
            previous=self._former if now.mono_s - self._moved_s < _MOVED_S else ZERO,
            exchange=self._exchange if each.right in HEARS.values() else b"",
            paths=each.paths,
            is_session=each.is_session,
            wants_costs=each.wants_costs,
        )
        return advertisement.signed(self._identity)

    def _rtcert_for(self, switch: Name) -> bytes:
        """Return the certificate by which this node lets a switch attract its traffic."""
        rtcert, until_s = self._rtcerts.get(switch, (b"", float("-inf")))
        if self._now.mono_s >= until_s:
            unix_s = int(self._now.unix_s)
            # dated back: the tolerance of a certificate's begin is for one clock, this is for the other
            begin_unix_s = unix_s - int(CLOCK_SKEW_S + _RTCERT.refresh_s / 2)
            rtcert = RtCert.make(self._identity, switch, Validity(begin_unix_s, unix_s + int(_RTCERT.lease_s)))
            self._rtcerts.pop(switch, None)
            self._rtcerts[switch] = rtcert, self._now.mono_s + _RTCERT.refresh_s
            if len(self._rtcerts) > _RTCERTS_MAX:
                del self._rtcerts[next(iter(self._rtcerts))]
        return rtcert

    def _note_newest(self, join: Join) -> None:
        """Note the sequence number of a join.

        Raises:
            StatementError: REPLAYED: a newer one overtook it, and its state of the tree is outdated.
        """
        for right in HEARS.values():
            pending_advertisement = self._advertisements.get((join.topic, right))
            if pending_advertisement is None:
                continue
            if join.sequence < pending_advertisement.join_sequence:
                raise StatementError(DropReason.REPLAYED, "a newer join overtook it")
            pending_advertisement.join_sequence = join.sequence
            if join.lease_s > 0:
                pending_advertisement.joins[join.path] = join
            else:
                pending_advertisement.joins.pop(join.path, None)

    def _handle_ack(self, statement: Statement, switch: Neighbour, now: Timestamps) -> Statement | None:
        """Process the acknowledgement of an advertisement, or return a statement about a publisher's location."""
        member = self._policy.verify_sender(statement, now.unix_s)
        if member.name != switch.name and member.role is not Role.RIB:
            raise StatementError(DropReason.BAD_CERTIFICATE, "an AdvertiseAck from a node that may not give it")
        statement.verify(member.key)
        if statement.type is StatementType.ANSWER:
            return statement
        if statement.type is StatementType.PRESENCE:
            presence = Presence.from_fields(statement.fields)
            if (presence.node, presence.incarnation) == (self._identity.name, self._incarnation):
                self.clashes += 1
                self.conflict_at = presence.other
            return None
        ack = AdvertiseAck.from_fields(statement.expect(StatementType.ADVERTISE_ACK))
        check_sequence(ack.sequence, now.unix_s)
        for (name, _), each in self._advertisements.items():
            if name == ack.name and ack.advertiser == self._identity.name:
                self._apply_ack(each, ack, now.mono_s)
        return None

    def _apply_ack(self, each: PendingAdvertisement, ack: AdvertiseAck, now_s: float) -> None:
        if ack.refused is None:
            # a RIB that is new acknowledges what it receives from the switch; that renews no lease
            if not each.is_taken or ack.sequence >= each.sent_sequence:
                self._requests.answered(each.key, now_s + renew_after_s(self._lease_s))
            each.is_taken, each.refused = True, None
            if each.right is Right.ATTACH:
                for other in self._advertisements.values():
                    if not other.is_acknowledged:
                        self._requests.hasten(other.key, now_s)
            return
        self.refusals[ack.refused] += 1
        each.is_taken = False
        if ack.refused is DropReason.STALE:
            self._sequence = self.started = max(self._sequence, ack.sequence)
            pause_s = 0.0  # an earlier incarnation of ours was ahead: retry above its number
        elif ack.refused is DropReason.IN_USE and each.right is Right.ATTACH:
            if each.refused is not ack.refused:
                self._in_use_s = now_s
            each.refused = ack.refused
            pause_s = _IN_USE_SOON_S if now_s < self._in_use_s + _IN_USE_S else _IN_USE_S
            self.clashes += 1
        else:
            each.refused = ack.refused
            pause_s = renew_after_s(self._lease_s)  # it may be accepted later; frequent repetition does not help
        self._requests.start(each.key, now_s + pause_s)

    def say(self, kind: Kind, wire: bytes, to: Name = ZERO) -> None:
        """Send a statement to the switch, or through it to another node."""
        assert self.switch is not None
        self.send(self.fragmenter.split(kind, wire, self.hello_protocol.ports[self.switch.port].mtu, to))

    def _next_sequence(self) -> int:
        self._sequence += 1
        return self._sequence


def attachment_waits(attachment: Attachment, now_s: float) -> list[Wait]:
    """Return what keeps a node from being attached with all it advertises; empty when nothing does."""
    if attachment.switch is None:
        ports = attachment.hello_protocol.ports.values()
        of_ports = [wait for port in ports for wait in port_waits(port, (Role.SWITCH, Role.LEAF))]
        strangers = list(stranger_waits(attachment.hello_protocol, now_s))
        refusing = {wait.port for wait in strangers}
        return [*strangers, *(w for w in of_ports if w.port not in refusing or w.reason is WaitReason.LINK_DOWN)]
    return list(_advertisement_waits(attachment))


def _advertisement_waits(attachment: Attachment) -> Iterator[Wait]:
    advertisements = attachment.advertisements
    if attachment.is_in_use:
        yield Wait(WaitReason.IN_USE)
        return
    if any(not each.is_acknowledged for each in advertisements):
        yield Wait(WaitReason.NO_RIB)
    for each in advertisements:
        if each.refused is not None:
            yield Wait(WaitReason.REFUSED, name=each.subject.name, refused=each.refused)
