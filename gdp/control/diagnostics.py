"""Diagnostic requests between members, and their replies.

Sans-I/O. A member asks another member, or the switch at which the hops of its request end, about a name. Both
statements are signed. A reply is never longer than its request, and each request gets one reply at most, so that
requests in another's name cannot amplify. Source for the hop limit: traceroute, RFC 1393, section 2.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from gdp.control.diagnostic_bodies import DiagnosticReply, DiagnosticRequest, cut_to_fit
from gdp.control.fragments import ControlFragmenter, ControlReassembler
from gdp.crypto.certificates import Membership
from gdp.crypto.identity import Identity
from gdp.crypto.schema import CERTIFICATE
from gdp.crypto.statements import Statement, StatementType, check_sequence, parse
from gdp.errors import DropReason, FrameError, LocalError, StatementError
from gdp.frame.codec import HOPS_AT, HOPS_MASK, Header, Kind
from gdp.limits import DIAGNOSTIC_FRAMES_RATE, DIAGNOSTIC_WAIT_S, DIAGNOSTICS_RATE, HOPS_MAX
from gdp.message.clock_offset import ClockEstimate, ClockOffset, ClockStamps
from gdp.message.replay import ReplayWindow
from gdp.names import ZERO, Name
from gdp.sansio import ReceivedFrame, Timestamps
from gdp.token_bucket import TokenBuckets
from gdp.trust.domain import Policy
from gdp.trust.lru import Lru

_PEERS_MAX: Final = 1_024  # whose certificates and replay windows are kept
_WINDOW: Final = 256  # requests of one member that may overtake each other
_PENDING_MAX: Final = 1_024  # requests of our own without a reply yet
_WAITING_MAX: Final = 64  # questions that wait for a RIB
_FIRST_LINK_BYTES: Final = 1_500  # ``ControlFragmenter`` splits for the smallest link anyway
_SHOWS_RIGHT: Final = "trace"  # the kind of request that shows a right on its name
_NO_BODY: Final[Mapping[str, object]] = {}


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """A verified request, for the function that answers it.

    Args:
        name: asked about; ``ZERO``: none.
        target: the member that the request was sent to; another one than this node where its hops ended here.
        is_neighbour: the asker itself sent it over one of our links, or is this node.
        port: that it came from; None: it is our own.
        mac: of the neighbour that it came from.
    """

    ask: str
    name: Name
    target: Name
    body: Mapping[str, Any]
    asker: Membership
    is_neighbour: bool
    port: int | None = None
    mac: bytes = b""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """A verified reply.

    Args:
        member: that answered.
        error: why it gave no result; empty: it did.
        is_withheld: it answers members of our domain with less than its own.
        is_cut: the rest would have made the reply longer than its request.
        switches: that the request passed before it came to the member, as that one counted.
        clock: what its wall clock is ahead of ours; None: not known.
    """

    member: Membership
    result: Mapping[str, Any]
    error: str = ""
    is_withheld: bool = False
    is_cut: bool = False
    switches: int = 0
    clock: ClockEstimate | None = None


Answerer = Callable[[Question, Timestamps], "Mapping[str, object] | None"]
OnReply = Callable[["Reply | None", float], None]
Send = Callable[[list[bytes], Name, Timestamps], object]


@dataclass(frozen=True, slots=True)
class _Registered:
    answer: Answerer
    for_foreign: bool


@dataclass(frozen=True, slots=True)
class _Pending:
    """A request of our own."""

    target: Name
    hops: int  # below ``HOPS_MAX`` a switch on the way may answer
    ask: str
    sent_s: float
    until_s: float
    on_reply: OnReply


@dataclass(frozen=True, slots=True)
class _Asked:
    """A question to answer: by a frame, or by a call here."""

    question: Question
    sequence: int
    reply_max_bytes: int
    knows_us: bool
    until_s: float
    on_reply: OnReply | None = None  # our own question
    begun_s: float = 0.0  # when it came
    hops_left: int = 0


@dataclass(slots=True)
class _Peer:
    """What is known of a member."""

    member: Membership
    seen: ReplayWindow = field(default_factory=lambda: ReplayWindow(_WINDOW))


class Diagnostics:
    """Diagnostic requests and replies of one node.

    Args:
        first_sequence: above every sequence number of an earlier incarnation.
        send: takes the frames of one statement to a member.

    Attributes:
        drops: what was refused, by reason.
        evidence_of: returns the fields that show this node's right on a name.
    """

    def __init__(
        self, identity: Identity, policy: Policy, fragmenter: ControlFragmenter, first_sequence: int, send: Send
    ) -> None:
        self._identity = identity
        self._policy = policy
        self._fragmenter = fragmenter
        self._sequence = first_sequence
        self._send = send
        self._answerers: dict[str, _Registered] = {}
        self._pending: OrderedDict[int, _Pending] = OrderedDict()
        self._waiting: list[_Asked] = []
        self._peers = Lru[_Peer](_PEERS_MAX)
        self._clocks = Lru[ClockOffset](_PEERS_MAX)
        self._clock_from_s: float | None = None  # when our stamps' clock showed 0: it says nothing of this machine
        self._knows_us: OrderedDict[Name, None] = OrderedDict()  # members that have our certificate
        self._frames = TokenBuckets(*DIAGNOSTIC_FRAMES_RATE)
        self._requests = TokenBuckets(*DIAGNOSTICS_RATE)
        self._reassembler = ControlReassembler()
        self._drops: Counter[DropReason] = Counter()
        self.evidence_of: Callable[[Name], Mapping[str, object]] = lambda _: _NO_BODY
        self.register("ping", lambda _question, _now: {}, for_foreign=True)

    @property
    def drops(self) -> Counter[DropReason]:
        """Return what was refused, by reason."""
        return self._drops + self._reassembler.drops

    def register(self, ask: str, answer: Answerer, *, for_foreign: bool = False) -> None:
        """Answer requests of a kind from now on.

        Args:
            answer: returns the result, for CBOR; None: not known yet, call it again when frames have come. Lists in
                it are shortened where the reply would be longer than its request, the last items first.
            for_foreign: members of every trusted domain get the result; else those of our own domain, and of domains
                that the policy names.
        """
        self._answerers[ask] = _Registered(answer, for_foreign)

    def clock_of(self, member: Name, now: Timestamps) -> ClockEstimate | None:
        """Return what a member's wall clock is ahead of ours, by its replies; None: there were none."""
        clock = self._clocks.get(member)
        return None if clock is None else clock.estimate(*now)

    def clocks(self, now: Timestamps) -> list[tuple[Membership, ClockEstimate]]:
        """Return what is known of the wall clocks of all members that have replied."""
        known = ((peer.member, self.clock_of(peer.member.name, now)) for peer in self._peers.values())
        return [(member, clock) for member, clock in known if clock is not None]

    # -- ask

    def ask(
        self,
        target: Name,
        ask: str,
        *,
        now: Timestamps,
        on_reply: OnReply,
        name: Name = ZERO,
        body: Mapping[str, object] = _NO_BODY,
        timeout_s: float = 0.5,
        reply_bytes: int = 0,
        hops: int = HOPS_MAX,
    ) -> None:
        """Send a request; ``on_reply`` is called once, with the reply and the seconds that it took, or with None.

        Args:
            target: a member: a proxy, a switch or a RIB. This node itself: answered without a frame.
            reply_bytes: longest reply that the request pays for; the least that suffices for an empty result if
                smaller.
            hops: the switch after so many links answers, if the target is further away.

        Raises:
            LocalError: the request is too large, or too many are under way.
        """
        self._sequence += 1
        until_s = now.mono_s + timeout_s
        if target == self._identity.name:
            own = Question(ask=ask, name=name, target=target, body=body, asker=self._identity.member, is_neighbour=True)
            self._answer(_Asked(own, self._sequence, 0, True, until_s, on_reply, now.mono_s), now)
            return
        if ask == _SHOWS_RIGHT:
            body = {**body, **self.evidence_of(name)}
        if len(self._pending) >= _PENDING_MAX:
            raise LocalError("too many diagnostic requests are under way; wait for their replies")
        is_limited = hops < HOPS_MAX  # so anyone may answer, and have no certificate of ours
        request = DiagnosticRequest(
            ask=ask,
            name=name,
            target=target,
            sequence=self._sequence,
            body=body,
            knows_target=not is_limited and self._peers.get(target) is not None,
            membership=b"" if target in self._knows_us and not is_limited else self._identity.member.wire,
        )
        wire = request.padded(self._identity.name, self._identity.key, reply_bytes)
        self._pending[self._sequence] = _Pending(target, hops, ask, now.mono_s, until_s, on_reply)
        self._put(Kind.DIAGNOSTIC_REQUEST, wire, target, now, hops)

    # -- frames

    def receive(self, header: Header, arrival: ReceivedFrame, now: Timestamps, neighbour: Name | None = None) -> None:
        """Handle a frame of either kind that is for this node, or a request whose hops have ended here.

        Args:
            neighbour: that sent the frame over the link; None: the node's own switch.

        Raises:
            RemoteError: it is refused, and the reason is not counted yet.
        """
        if not self._frames.spend(arrival.via, now.mono_s):
            raise FrameError(DropReason.RATE_LIMITED, "diagnostic frames of one neighbour")
        wire = self._reassembler.add(header, arrival.frame, now.mono_s, arrival.via)
        if wire is None:
            return
        statement = parse(wire)
        if statement.signer != header.source:
            raise StatementError(DropReason.UNKNOWN_SENDER, "signed by another than its sender")
        if header.kind == Kind.DIAGNOSTIC_REQUEST:
            self._receive_request(statement, header, arrival, now, is_neighbour=neighbour == statement.signer)
        else:
            self._receive_reply(statement, arrival, now)

    def handle_timer(self, now: Timestamps) -> None:
        """End what has waited too long, and try again what waits."""
        self._reassembler.drop_expired(now.mono_s)
        for sequence, each in [item for item in self._pending.items() if item[1].until_s <= now.mono_s]:
            del self._pending[sequence]
            self._knows_us.pop(each.target, None)  # it may have started again
            each.on_reply(None, now.mono_s - each.sent_s)
        self.answer_waiting(now)

    def answer_waiting(self, now: Timestamps) -> None:
        """Try again to answer what waits for something that the node did not know."""
        waiting, self._waiting = self._waiting, []
        for asked in waiting:
            self._answer(asked, now)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        if not self._pending and not self._waiting:
            return None
        return min([each.until_s for each in self._pending.values()] + [each.until_s for each in self._waiting])

    # -- internals

    def _receive_request(
        self, statement: Statement, header: Header, arrival: ReceivedFrame, now: Timestamps, *, is_neighbour: bool
    ) -> None:
        fields = statement.expect(StatementType.DIAGNOSTIC_REQUEST)
        peer = self._verified(statement, now)
        request = DiagnosticRequest.from_fields(fields)
        if request.target != header.destination:
            raise StatementError(DropReason.NOT_FOR_US, "a request to another member")
        if not self._requests.spend(statement.signer, now.mono_s):
            raise StatementError(DropReason.RATE_LIMITED, "diagnostic requests of one member")
        check_sequence(request.sequence, now.unix_s)
        if peer.seen.is_finished(request.sequence):
            raise StatementError(DropReason.REPLAYED, "diagnostic request")
        peer.seen.finish(request.sequence)
        question = Question(
            ask=request.ask,
            name=request.name,
            target=request.target,
            body=request.body,
            asker=peer.member,
            is_neighbour=is_neighbour,
            port=arrival.port,
            mac=arrival.mac,
        )
        until_s = now.mono_s + DIAGNOSTIC_WAIT_S
        asked = _Asked(
            question,
            request.sequence,
            len(statement.wire),
            request.knows_target,
            until_s,
            begun_s=now.mono_s - arrival.waited_s,
            hops_left=header.hops_left & HOPS_MASK,
        )
        self._answer(asked, now)

    def _answer(self, asked: _Asked, now: Timestamps) -> None:
        registered = self._answerers.get(asked.question.ask)
        is_open = asked.question.asker.domain in self._policy.diagnostics
        result: Mapping[str, object] | None = {}
        error = "" if registered is not None else "unknown-ask"
        if registered is not None and (is_open or registered.for_foreign):
            result = registered.answer(asked.question, now)
        if result is None and now.mono_s < asked.until_s and len(self._waiting) < _WAITING_MAX:
            self._waiting.append(asked)
            return
        if result is None:
            result, error = {}, "not-known"
        if asked.on_reply is not None:
            reply = Reply(member=self._identity.member, result=result, error=error)
            asked.on_reply(reply, now.mono_s - asked.begun_s)
            return
        made = DiagnosticReply(
            ask=asked.question.ask,
            sequence=asked.sequence,
            asker=asked.question.asker.name,
            result=result,
            error=error,
            is_withheld=not is_open,
            hops_left=asked.hops_left,
            membership=b"" if asked.knows_us else self._identity.member.wire,
            clock=self._stamps(asked.begun_s, now).to_wire(),
        )
        fitting = cut_to_fit(made, asked.reply_max_bytes)
        if fitting is None:
            self._drops[DropReason.TOO_BIG] += 1
            return
        wire = fitting.to_wire(self._identity.name, self._identity.key)
        self._put(Kind.DIAGNOSTIC_REPLY, wire, asked.question.asker.name, now)

    def _receive_reply(self, statement: Statement, arrival: ReceivedFrame, now: Timestamps) -> None:
        fields = statement.expect(StatementType.DIAGNOSTIC_REPLY)
        reply = DiagnosticReply.from_fields(fields)
        pending = self._pending.get(reply.sequence)
        if pending is None or reply.asker != self._identity.name or reply.ask != pending.ask:
            raise StatementError(DropReason.STALE, "a reply without a request")
        if pending.hops == HOPS_MAX and statement.signer != pending.target:
            raise StatementError(DropReason.UNKNOWN_SENDER, "a reply of a member that was not asked")
        member = self._verified(statement, now).member
        if member.name != pending.target and not member.role.is_switch:
            raise StatementError(DropReason.UNKNOWN_SENDER, "a reply of a member that is not on the path")
        del self._pending[reply.sequence]
        self._knows_us[member.name] = None
        self._knows_us.move_to_end(member.name)
        if len(self._knows_us) > _PEERS_MAX:
            self._knows_us.popitem(last=False)
        came_s = now.mono_s - arrival.waited_s
        rtt_s = max(came_s - pending.sent_s, 0.0)
        if reply.clock:
            clock = self._clocks.get(member.name) or ClockOffset()
            clock.add(pending.sent_s, ClockStamps.from_wire(reply.clock), came_s, now.mono_s)
            self._clocks.put(member.name, clock)
        made = Reply(
            member=member,
            result=reply.result,
            error=reply.error,
            is_withheld=reply.is_withheld,
            is_cut=reply.is_cut,
            switches=max(pending.hops - reply.hops_left, 0),
            clock=self.clock_of(member.name, now),
        )
        pending.on_reply(made, rtt_s)

    def _stamps(self, came_s: float, now: Timestamps) -> ClockStamps:
        if self._clock_from_s is None:
            self._clock_from_s = came_s
        from_s, ahead_s = self._clock_from_s, now.unix_s - now.mono_s + self._clock_from_s
        return ClockStamps(*(round(1e6 * each_s) for each_s in (came_s - from_s, now.mono_s - from_s, ahead_s)))

    def _verified(self, statement: Statement, now: Timestamps) -> _Peer:
        """Return the signer of a statement, whose signature is proved.

        Raises:
            StatementError: it is no member now, its certificate is neither here nor known, or the signature is wrong.
        """
        peer = self._peers.get(statement.signer)
        if CERTIFICATE.key in statement.fields:
            member = self._policy.verify_sender(statement, now.unix_s)
        elif peer is not None:
            member = peer.member
            self._policy.check_member(member, now.unix_s)
        else:
            raise StatementError(DropReason.UNKNOWN_SENDER, "no certificate came, and none is known")
        statement.verify(member.key)
        if peer is None:
            peer = _Peer(member)
            self._peers.put(statement.signer, peer)
        peer.member = member
        return peer

    def _put(self, kind: Kind, wire: bytes, to: Name, now: Timestamps, hops: int = HOPS_MAX) -> None:
        frames = self._fragmenter.split(kind, wire, _FIRST_LINK_BYTES, to)
        self._send([frame[:HOPS_AT] + bytes([hops]) + frame[HOPS_AT + 1 :] for frame in frames], to, now)
