"""Advertisement: a node's statement of what it does with a name, with all proofs that it may.

Sans-I/O. Source: docs/explanation/design.md, section 5. The node signs it, and its switch relays it to a RIB. RIBs
relay it up the tiers, and down in responses. Each receiver verifies the bytes again and trusts no relay.

::

    owner's key ==AdCert(s)==> node ==RtCert==> switch
    domain root ==membership=> node ==signs===> advertisement (name, right, sequence, incarnation, lease)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from gdp.crypto.certificates import Membership
from gdp.crypto.exchange import EXCHANGE_KEY_BYTES
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, StatementType
from gdp.crypto.subject import Subject
from gdp.errors import DropReason, LocalError, StatementError
from gdp.limits import ADVERTISEMENT_MAX_BYTES, CHAIN_MAX, LEASE_MAX_S, LEASE_MIN_S, SPREAD
from gdp.names import ZERO, Name
from gdp.trust.adcert import Chain
from gdp.trust.right import Right
from gdp.trust.rtcert import RtCert

__all__ = ["Advertisement", "UnverifiedAdvertisement", "paths_value", "session_value", "sign_advertisement"]

_MS = 1_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Advertisement:
    """A verified advertisement; only ``AdvertisementVerifier`` makes one.

    Args:
        subject: the name and what proves it.
        chain: the delegations from the owner; empty links where the node owns the name.
        rtcert: which switch may attract the traffic.
        sequence: a newer advertisement of the same node and name has a higher one.
        incarnation: of the node's present run; readers open nothing else (docs/explanation/design.md, section 4).
        lease_s: how long it is valid unless refreshed, within the bounds of ``limits``.
        is_global: whether it is also advertised to the tier above.
        wire: the bytes that were verified, to be relayed unchanged.
        previous: the switch that the node has come from, or ``ZERO``.
        exchange: the node's X25519 key in this run, for control messages to it; empty where it takes none.
        paths: over how many disjoint paths the node wants to send or receive each frame of this name.
        is_session: a session secret may authenticate the unicast streams of this name that the node sends or receives.
    """

    subject: Subject
    right: Right
    member: Membership
    chain: Chain
    rtcert: RtCert
    sequence: int
    incarnation: int
    lease_s: float
    is_global: bool
    wire: bytes = field(repr=False)
    previous: Name = ZERO
    exchange: bytes = b""
    paths: int = 1
    is_session: bool = False

    @property
    def name(self) -> Name:
        """Return the advertised name."""
        return self.subject.name

    @property
    def node(self) -> Name:
        """Return the name of the node that advertises."""
        return self.member.name

    @property
    def switch(self) -> Name:
        """Return the switch at which the node is attached."""
        return self.rtcert.switch

    @property
    def domain(self) -> Name:
        """Return the node's trust domain."""
        return self.member.domain

    @property
    def valid_until_unix_s(self) -> int:
        """Return when the first piece of evidence expires; no lease should outlast it."""
        links = [link.validity.not_after_unix_s for link in self.chain.links]
        return min(self.member.not_after_unix_s, self.rtcert.validity.not_after_unix_s, *links)

    @property
    def issuers(self) -> frozenset[bytes]:
        """Return the keys, 33 bytes each, that may revoke part of the evidence, apart from the domain's root."""
        given = [key for link in self.chain.links for key in (link.subject.owner_key, link.delegate_key)]
        return frozenset((self.member.key.compressed, *given))

    @property
    def fingerprints(self) -> frozenset[bytes]:
        """Return the fingerprints of all evidence: when one of them is revoked, call the verifier's ``recheck``."""
        links = [link.fingerprint for link in self.chain.links]
        return frozenset((self.member.fingerprint, self.rtcert.fingerprint, *links))


@dataclass(frozen=True, slots=True, kw_only=True)
class UnverifiedAdvertisement:
    """The content of an advertisement, parsed but not verified."""

    subject: Subject
    right: Right
    sequence: int
    incarnation: int
    lease_ms: int
    is_global: bool
    membership: bytes
    chain: tuple[bytes, ...]
    rtcert: bytes
    previous: Name = ZERO
    exchange: bytes = b""
    paths: int = 1
    is_session: bool = False

    @classmethod
    def from_statement(cls, statement: Statement) -> UnverifiedAdvertisement:
        """Read a parsed statement; the name's hash is checked, no signature is.

        Raises:
            StatementError: MALFORMED, WRONG_NAME or TOO_BIG.
        """
        fields = statement.expect(StatementType.ADVERTISE)
        if len(statement.wire) > ADVERTISEMENT_MAX_BYTES:
            raise StatementError(DropReason.TOO_BIG, f"an advertisement of {len(statement.wire)} bytes")
        exchange = fields.bytes_("x")
        if len(exchange) not in (0, EXCHANGE_KEY_BYTES):
            raise StatementError(DropReason.MALFORMED, "an exchange key of the wrong length")
        paths = fields.uint("paths", SPREAD) if "paths" in fields else 1
        if not paths:
            raise StatementError(DropReason.MALFORMED, "no path at all")
        return cls(
            subject=Subject.from_fields(fields, fields.name("name")),
            right=Right.from_wire(fields.text("right")),
            sequence=fields.uint("seq"),
            incarnation=fields.uint("inc"),
            lease_ms=fields.uint("lease"),
            is_global=fields.flag("global"),
            membership=fields.bytes_("member"),
            chain=tuple(fields.byte_strings("chain", CHAIN_MAX)),
            rtcert=fields.bytes_("rt"),
            previous=fields.name("prev") if "prev" in fields else ZERO,
            exchange=exchange,
            paths=paths,
            is_session="session" in fields and fields.flag("session"),
        )

    def to_fields(self) -> dict[str, object]:
        """Return the statement's body."""
        moved = {} if self.previous == ZERO else {"prev": self.previous}
        several = {} if self.paths == 1 else {"paths": self.paths}
        session = {"session": True} if self.is_session else {}
        return {
            **moved,
            **several,
            **session,
            **self.subject.to_fields(),
            "name": self.subject.name,
            "right": self.right.value,
            "seq": self.sequence,
            "inc": self.incarnation,
            "lease": self.lease_ms,
            "global": self.is_global,
            "member": self.membership,
            "chain": list(self.chain),
            "rt": self.rtcert,
            "x": self.exchange,
        }


def sign_advertisement(
    identity: Identity,
    right: Right,
    subject: Subject,
    *,
    rtcert: bytes,
    sequence: int,
    incarnation: int,
    lease_s: float,
    is_global: bool,
    chain: Sequence[bytes] = (),
    previous: Name = ZERO,
    exchange: bytes = b"",
    paths: int = 1,
    is_session: bool = False,
) -> bytes:
    """Return a node's signed advertisement; costs about 50 us.

    Args:
        subject: the name: a delegation's, or ``identity.subject`` for the node's own.
        rtcert: for the switch at which the node is attached; see ``RtCert.make``.
        sequence: higher than that of any earlier advertisement of the name by this node.
        incarnation: random at each start of the node, 64 bits.
        lease_s: within the bounds of ``limits``.
        is_global: whether other domains may find it.
        chain: the AdCerts of the delegation.
        previous: the node's former switch, which is to be notified; ``ZERO``: it has not moved.
        exchange: its X25519 key in this run, for control messages to it; empty where it takes none.
        paths: over how many disjoint paths each frame of the name is to travel, 1 or 2; ``SPREAD``: striped over two.
        is_session: a session secret may authenticate its unicast streams of the name, with nodes that say the same.

    Raises:
        LocalError: a lease out of bounds, or more than one statement can carry.
    """
    if not LEASE_MIN_S <= lease_s <= LEASE_MAX_S:
        raise LocalError(f"a lease lasts from {LEASE_MIN_S} to {LEASE_MAX_S} s, not {lease_s}")
    body = UnverifiedAdvertisement(
        subject=subject,
        right=right,
        sequence=sequence,
        incarnation=incarnation,
        lease_ms=round(lease_s * _MS),
        is_global=is_global,
        membership=identity.membership,
        chain=tuple(chain),
        rtcert=rtcert,
        previous=previous,
        exchange=exchange,
        paths=paths,
        is_session=is_session,
    )
    wire = identity.sign(StatementType.ADVERTISE, body.to_fields())
    if len(wire) > ADVERTISEMENT_MAX_BYTES:
        raise LocalError(
            f"an advertisement of {len(wire)} bytes, above {ADVERTISEMENT_MAX_BYTES}: shorten metadata or delegations"
        )
    return wire


def paths_value(paths: object) -> int:
    """Return how an advertisement writes a number of paths.

    Raises:
        LocalError: it is neither 1, 2 nor ``spread``.
    """
    if paths == "spread":
        return SPREAD
    if paths not in (1, 2):
        raise LocalError(f"paths is 1, 2 or 'spread', not {paths!r}")
    return int(paths == 2) + 1


def session_value(sign: object) -> bool:
    """Return whether an advertisement allows session secrets instead of signatures.

    Raises:
        LocalError: it is neither ``always`` nor ``session``.
    """
    if sign not in ("always", "session"):
        raise LocalError(f"sign is 'always' or 'session', not {sign!r}")
    return sign == "session"
