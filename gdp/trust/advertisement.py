"""Advertisement: a node's statement of what it does with a name, with all proofs that it may.

Sans-I/O. Source: docs/explanation/design.md, section 5. The node signs it, and its switch relays it to a RIB. RIBs
relay it up the tiers, and down in responses. Each receiver verifies the bytes again and trusts no relay.

::

    owner's key ==AdCert(s)==> node ==RtCert==> switch
    domain root ==membership=> node ==signs===> advertisement (name, right, sequence, incarnation, lease)
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Final

from gdp.crypto.certificates import Membership
from gdp.crypto.exchange import EXCHANGE_KEY_BYTES
from gdp.crypto.identity import Identity
from gdp.crypto.schema import CERT, FLAG, NAME, STATEMENT, Body, Keyed, octets, or_empty, uint
from gdp.crypto.statements import Statement, StatementType, check_sequence
from gdp.crypto.subject import NAMED_SUBJECT, Subject
from gdp.errors import LocalError
from gdp.intervals import LEASE_MAX_S, LEASE_MIN_S
from gdp.limits import ADVERTISEMENT_MAX_BYTES, SPREAD, WITHDRAWAL_MAX_BYTES
from gdp.names import ZERO, Name
from gdp.trust.adcert import CHAIN, Chain
from gdp.trust.right import RIGHT, Right
from gdp.trust.rtcert import RtCert

MS: Final = 1_000


@dataclass(frozen=True, slots=True, kw_only=True)
class _Advertised(Body):
    """What a node says of itself and the name.

    Args:
        subject: the name and what proves it: a delegation's, or the node's own.
        sequence: a newer advertisement of the same node and name has a higher one.
        incarnation: of the node's present run, random, 64 bits; readers open nothing else (docs/explanation/design.md,
            section 4).
        is_global: whether it is also advertised to the tier above, where other domains may find it.
        previous: the switch that the node has come from, which is to be notified, or ``ZERO``.
        exchange: the node's X25519 key in this run, for control messages to it; empty where it takes none.
        paths: over how many disjoint paths the node wants to send or receive each frame of this name, 1 or 2;
            ``SPREAD``: striped over two.
        is_session: a session secret may authenticate the unicast streams of this name that the node sends or receives,
            with nodes that say the same.
        wants_costs: its switch is to state the costs of the paths to those that it hears on this name.
    """

    TYPE = StatementType.ADVERTISE
    MAX_BYTES = ADVERTISEMENT_MAX_BYTES
    subject: Annotated[Subject, NAMED_SUBJECT]
    right: Annotated[Right, Keyed("right", RIGHT)]
    sequence: Annotated[int, Keyed("seq", uint())]
    incarnation: Annotated[int, Keyed("inc", uint())]
    is_global: Annotated[bool, Keyed("global", FLAG)]
    previous: Annotated[Name, Keyed("prev", NAME, absent=ZERO, is_omitted=True)] = ZERO
    exchange: Annotated[bytes, Keyed("x", or_empty(octets(EXCHANGE_KEY_BYTES), b""))] = b""
    paths: Annotated[int, Keyed("paths", uint(SPREAD, 1), absent=1, is_omitted=True)] = 1
    is_session: Annotated[bool, Keyed("session", FLAG, absent=False, is_omitted=True)] = False
    wants_costs: Annotated[bool, Keyed("costs", FLAG, absent=False, is_omitted=True)] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class UnverifiedAdvertisement(_Advertised):
    """An advertisement as it is signed, or parsed but not verified: only the name's hash is checked.

    Args:
        lease_ms: how long it is valid unless refreshed.
        rtcert: for the switch at which the node is attached; see ``RtCert.make``.
        membership: of the node, DER; ``signed`` sets it.
        chain: the AdCerts of the delegation.
    """

    lease_ms: Annotated[int, Keyed("lease", uint())]
    rtcert: Annotated[bytes, Keyed("rt", STATEMENT)]
    membership: Annotated[bytes, Keyed("member", CERT)] = b""
    chain: Annotated[tuple[bytes, ...], Keyed("chain", CHAIN)] = ()

    def signed(self, identity: Identity) -> bytes:
        """Return the node's signed statement; costs about 50 us.

        Raises:
            LocalError: a lease out of the bounds of ``limits``, or more than one statement can carry.
        """
        if not LEASE_MIN_S * MS <= self.lease_ms <= LEASE_MAX_S * MS:
            raise LocalError(f"a lease lasts from {LEASE_MIN_S} to {LEASE_MAX_S} s, not {self.lease_ms} ms")
        wire = replace(self, membership=identity.membership).to_wire(identity.name, identity.key)
        if len(wire) > self.MAX_BYTES:
            raise LocalError(
                f"an advertisement of {len(wire)} bytes, above {self.MAX_BYTES}: shorten metadata or delegations"
            )
        return wire

    def verified(self, member: Membership, chain: Chain, rtcert: RtCert, wire: bytes) -> Advertisement:
        """Return the advertisement, whose evidence the caller has verified."""
        said = {each.name: getattr(self, each.name) for each in fields(_Advertised)}
        lease_s = self.lease_ms / MS
        return Advertisement(**said, lease_s=lease_s, member=member, chain=chain, rtcert=rtcert, wire=wire)


@dataclass(frozen=True, slots=True, kw_only=True)
class Advertisement(_Advertised):
    """A verified advertisement; only ``AdvertisementVerifier`` makes one.

    Args:
        chain: the delegations from the owner; empty links where the node owns the name.
        rtcert: which switch may attract the traffic.
        lease_s: how long it is valid unless refreshed, within the bounds of ``limits``.
        wire: the bytes that were verified, to be relayed unchanged.
    """

    member: Membership
    chain: Chain
    rtcert: RtCert
    lease_s: float
    wire: bytes = field(repr=False)

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


@dataclass(frozen=True, slots=True)
class Withdrawal(Body):
    """The name and the right that its signer advertises no more. Source: BGP (RFC 4271, section 3.1).

    Its sequence number counts with those of the node's advertisements, so that a late one ends nothing newer.
    """

    TYPE = StatementType.WITHDRAW
    MAX_BYTES = WITHDRAWAL_MAX_BYTES
    name: Annotated[Name, Keyed("n", NAME)]
    right: Annotated[Right, Keyed("right", RIGHT)]
    sequence: Annotated[int, Keyed("s", uint())]

    @classmethod
    def received(cls, statement: Statement, unix_s: float) -> Withdrawal:
        """Read a parsed statement; no signature is checked.

        Raises:
            StatementError: MALFORMED, or TOO_BIG to be forwarded.
        """
        withdrawal = cls.from_statement(statement)
        check_sequence(withdrawal.sequence, unix_s)
        return withdrawal
