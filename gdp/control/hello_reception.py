"""Reception of hellos: frames are joined and checks are made, the cheap ones first, before anything is believed.

Sans-I/O; time comes in as ``Timestamps``. ``admission.py`` decides which signatures are verified, and how often.
Strangers' unfinished hellos have memory of their own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Final, NamedTuple

from gdp.control.admission import NEIGHBOUR_HELLOS, Cookies, cookie_payload
from gdp.control.fragments import ControlFragmenter, ControlReassembler
from gdp.control.hello import HELLO_MAX_BYTES, Hello, NodeSettings
from gdp.control.hello_port import HelloPort
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, StatementType
from gdp.errors import DropReason, FrameError, StatementError
from gdp.frame.codec import HEADER_BYTES, Header, Kind
from gdp.limits import MTU_MIN_BYTES
from gdp.names import Name
from gdp.sansio import OutgoingFrames, ReceivedFrame, Timestamps
from gdp.token_bucket import TokenBucket
from gdp.trust.domain import Policy
from gdp.trust.rtcert import RtCertCache

_PARTS_MAX: Final = -(-HELLO_MAX_BYTES // (MTU_MIN_BYTES - HEADER_BYTES))
_RTCERTS_REMEMBERED: Final = 256


class VerifiedHello(NamedTuple):
    """A hello whose signer is a member.

    Attributes:
        proof: of a RIB that is attached to this switch: its membership and its RtCert, which prove it to others.
    """

    hello: Hello
    member: Membership
    proof: tuple[bytes, bytes] | None


class HelloReception:
    """Reception of hellos at all ports of one node.

    Args:
        ports: those of the hello protocol, by index.

    Attributes:
        reply_at_s: monotonic second at which cookies are to be sent; infinity: there are none.
    """

    def __init__(
        self,
        identity: Identity,
        policy: Policy,
        fragmenter: ControlFragmenter,
        settings: NodeSettings,
        ports: Mapping[int, HelloPort],
    ) -> None:
        self._identity = identity
        self._policy = policy
        self._fragmenter = fragmenter
        self._ports = ports
        self._cookies = Cookies(settings.random_bytes)
        self._rtcerts = RtCertCache(_RTCERTS_REMEMBERED)
        self._reassembler = ControlReassembler()  # of neighbours' hellos
        self._strangers_reassembler = ControlReassembler()
        self._replies: list[OutgoingFrames] = []
        self.reply_at_s = float("inf")

    @property
    def drops(self) -> Counter[DropReason]:
        """Return the unfinished hellos that were given up, by reason."""
        return self._reassembler.drops + self._strangers_reassembler.drops

    @property
    def held_bytes(self) -> int:
        """Return how much memory unfinished hellos of strangers hold."""
        return self._strangers_reassembler.held_bytes

    def drop_expired(self, now_s: float) -> None:
        """Give up the hellos that were not finished in time."""
        self._reassembler.drop_expired(now_s)
        self._strangers_reassembler.drop_expired(now_s)

    def replies_to_send(self) -> list[OutgoingFrames]:
        """Return, once, the cookies to send."""
        replies, self._replies, self.reply_at_s = self._replies, [], float("inf")
        return replies

    def join(self, arrival: ReceivedFrame, header: Header, now_s: float) -> bytes | None:
        """Add a frame of a hello; return the statement when it is complete.

        Raises:
            FrameError: BAD_PARTS, MEMORY_FULL and the like; RATE_LIMITED, its address has used up its share.
        """
        port = self._ports.get(arrival.port)
        if header.parts > _PARTS_MAX:
            raise FrameError(DropReason.BAD_PARTS, f"a hello in {header.parts} parts")
        if port is None or not port.is_up:
            return None
        if port.neighbour_at(arrival.mac, is_up=True) is not None:
            return self._reassembler.add(header, arrival.frame, now_s, arrival.via)
        port.admission.check_quota(arrival.mac, now_s)
        return self._strangers_reassembler.add(header, arrival.frame, now_s, arrival.via)

    def verified(self, port: HelloPort, arrival: ReceivedFrame, statement: Statement, now: Timestamps) -> VerifiedHello:
        """Return a verified hello, cheap checks first.

        Raises:
            StatementError: the hello is invalid, or no more are verified now; of a RIB, it did not sign its RtCert.
        """
        if len(statement.wire) > HELLO_MAX_BYTES:
            raise StatementError(DropReason.TOO_BIG, "hello")
        hello = Hello.from_fields(statement.expect(StatementType.HELLO))
        if statement.signer == self._identity.name:
            raise StatementError(DropReason.NOT_FOR_US, "our own hello came back")
        if hello.sequence <= port.last_of(statement.signer, hello.nonce):
            port.admission.refused(now.mono_s)
            raise StatementError(DropReason.REPLAYED, "hello")
        self._admit(port, arrival, statement.signer, hello, now.mono_s)
        try:
            member = self._policy.verify_membership(hello.membership, now.unix_s)
        except StatementError as error:
            port.strangers.record(hello.membership, error.reason, now.mono_s)
            raise
        if member.name != statement.signer:
            raise StatementError(DropReason.BAD_CERTIFICATE, "a hello under another's certificate")
        statement.verify(member.key)
        roles = member.role, self._identity.role
        if Role.LEAF in roles and all(each.is_switch for each in roles) and member.domain != self._identity.root.domain:
            port.strangers.record(hello.membership, DropReason.THROUGH_LEAF, now.mono_s)
            raise StatementError(DropReason.THROUGH_LEAF, "a leaf joins switches of its own domain only")
        return VerifiedHello(hello, member, self._proof_of_place(hello, member))

    def _admit(self, port: HelloPort, arrival: ReceivedFrame, signer: Name, hello: Hello, now_s: float) -> None:
        """Decide by cheap checks whether a hello's signature is verified.

        Raises:
            StatementError: RATE_LIMITED; COOKIE_REQUIRED, and a cookie is queued.
        """
        known = port.neighbours.get(signer)
        member = known.member if known is not None else None
        seen = arrival.mac, hello.membership
        if known is not None and member is not None and known.is_proven and (known.mac, member.wire) == seen:
            known.hellos = known.hellos or TokenBucket(*NEIGHBOUR_HELLOS)
            port.admission.admit_neighbour(known.hellos, now_s)
            return
        try:
            port.admission.admit_stranger(
                arrival.mac, now_s, lambda: self._cookies.proves(hello, port.nonce, arrival.mac, now_s)
            )
        except StatementError as error:
            if error.reason is DropReason.COOKIE_REQUIRED and port.admission.may_send_cookie(now_s):
                cookie = self._cookies.make(port.nonce, arrival.mac, now_s)
                payload = cookie_payload(port.nonce, hello.nonce, cookie)
                frames = self._fragmenter.split(Kind.COOKIE, payload, MTU_MIN_BYTES)
                self._replies.append(OutgoingFrames(port.index, arrival.mac, frames))
                self.reply_at_s = min(self.reply_at_s, now_s)
            raise

    def _proof_of_place(self, hello: Hello, member: Membership) -> tuple[bytes, bytes] | None:
        if member.role is not Role.RIB:
            return None
        for wire in hello.rtcerts:
            rtcert = self._rtcerts.verified(wire, member.name, member.key)
            if rtcert.switch == self._identity.name:
                return hello.membership, wire
        return None
