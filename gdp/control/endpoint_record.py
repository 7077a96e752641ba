"""Endpoint record: where a switch can be reached across IP networks, signed by the switch itself.

Sans-I/O. A record names the WireGuard key of each uplink and the candidates at which it may answer, as ICE has them
(RFC 8445, section 5.1). Records travel in enrolments, in files and through the RIB.

The RIBs of one domain equalise a set of records. Its keys are names of switches, its ranks the sequences of records. A
switch requests the records of switches by their whole names, each with the line of the record that it has. A RIB
requests in the same way the switch's own record, so that a publication needs no acknowledgement of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Annotated, Final, NamedTuple

from gdp.control.endpoints import ENDPOINT_MAX_BYTES, Endpoint
from gdp.crypto.certificates import Membership
from gdp.crypto.identity import Identity
from gdp.crypto.schema import CERTIFICATE, Body, Keyed, many, mapped, octets, one_of, row, uint
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.crypto.tunnel_key import TUNNEL_KEY_BYTES
from gdp.errors import DropReason, StatementError
from gdp.names import Name
from gdp.trust.domain import Policy

ENDPOINTS: Final = b"endpoints"
ENDPOINT_NAMES_MAX: Final = 64  # in one request of a switch
_LEASE_BYTES: Final = 4
CANDIDATES_MAX: Final = 16
UPLINKS_MAX: Final = 4
RECORD_MAX_BYTES: Final = 4 << 10


class CandidateType(str, Enum):
    """Origin of a candidate; RFC 8445, section 4."""

    HOST = "host"  # an address of a device of the node
    REFLEXIVE = "srflx"  # as a border sees it
    PUBLIC = "public"  # stated by the operator: reachable from everywhere
    RELAY_TLS = "tls"  # a TCP endpoint where frames pass through TLS


class Candidate(NamedTuple):
    """A possible endpoint of one uplink."""

    uplink: int
    type: CandidateType
    endpoint: Endpoint


_ENDPOINT: Final = mapped(octets(most=ENDPOINT_MAX_BYTES), Endpoint.from_wire, Endpoint.to_wire)
_CANDIDATE: Final = row(Candidate, uint(), one_of(CandidateType), _ENDPOINT)


@dataclass(frozen=True, slots=True, kw_only=True)
class EndpointRecord(Body):
    """A record of one switch.

    Args:
        name: of the switch.
        keys: the WireGuard public key of each uplink, ``TUNNEL_KEY_BYTES`` each.
        candidates: in the order in which they are tried.
        sequence: rises with each record of the switch; Unix milliseconds suffice.
        until_unix_s: the record is void after this second.
        membership: the switch's certificate, DER.
        wire: the signed statement.
    """

    TYPE = StatementType.ENDPOINTS
    name: Name
    keys: Annotated[tuple[bytes, ...], Keyed("k", many(octets(TUNNEL_KEY_BYTES), UPLINKS_MAX))]
    candidates: Annotated[tuple[Candidate, ...], Keyed("a", many(_CANDIDATE, CANDIDATES_MAX))]
    sequence: Annotated[int, Keyed("s", uint())]
    until_unix_s: Annotated[int, Keyed("u", uint())]
    membership: Annotated[bytes, CERTIFICATE] = field(repr=False)
    wire: bytes = field(default=b"", repr=False)

    @classmethod
    def make(
        cls,
        identity: Identity,
        keys: tuple[bytes, ...],
        candidates: tuple[Candidate, ...],
        *,
        sequence: int,
        until_unix_s: int,
    ) -> EndpointRecord:
        """Return a record that the node signs; candidates beyond ``CANDIDATES_MAX`` are left out."""
        record = cls(
            name=identity.name,
            keys=keys,
            candidates=candidates[:CANDIDATES_MAX],
            sequence=sequence,
            until_unix_s=until_unix_s,
            membership=identity.membership,
        )
        return replace(record, wire=record.to_wire(identity.name, identity.key))

    @classmethod
    def verified(cls, wire: bytes, policy: Policy, unix_s: float) -> tuple[EndpointRecord, Membership]:
        """Read a record; verify its membership, its signature and that it is not void.

        Raises:
            StatementError: TOO_BIG, MALFORMED, BAD_SIGNATURE, EXPIRED, or as ``Policy.verify_membership``.
        """
        if len(wire) > RECORD_MAX_BYTES:
            raise StatementError(DropReason.TOO_BIG, "endpoint record")
        statement = parse(wire)
        record = cls.from_statement(statement)
        member = policy.verify_sender(statement, unix_s)
        statement.verify(member.key)
        if record.until_unix_s < unix_s:
            raise StatementError(DropReason.EXPIRED, "endpoint record")
        return record, member

    @classmethod
    def given_by(cls, statement: Statement) -> dict[str, object]:
        """Return the switch and the bytes."""
        return {"name": statement.signer, "wire": statement.wire}

    def check(self) -> None:
        """Return if there are keys, and each candidate is of an uplink. Raises ``StatementError``: MALFORMED."""
        if not self.keys or any(each.uplink >= len(self.keys) for each in self.candidates):
            raise StatementError(DropReason.MALFORMED, "an endpoint record without the key of an uplink")


def item_of(record: bytes, lease_s: float) -> bytes:
    """Return the item of a record: what is left of its lease (ms, 4 bytes), and the signed record."""
    return int(lease_s * 1_000).to_bytes(_LEASE_BYTES, "big") + record


def record_in(item: bytes) -> tuple[bytes, float]:
    """Return the record in an item, and what is left of its lease, in seconds. Raises ``StatementError``: MALFORMED."""
    if len(item) <= _LEASE_BYTES:
        raise StatementError(DropReason.MALFORMED, "an item without a record")
    return item[_LEASE_BYTES:], int.from_bytes(item[:_LEASE_BYTES], "big") / 1_000
