"""Endpoint record: where a switch can be reached across IP networks, signed by the switch itself.

Sans-I/O. A record names the WireGuard key of each uplink and the candidates at which it may answer, as ICE has them
(RFC 8445, section 5.1). Records travel in enrolments, in files and through the RIB.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Final, NamedTuple

from gdp.control.endpoints import Endpoint
from gdp.crypto.certificates import Membership
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Fields, StatementType, parse
from gdp.crypto.tunnel_key import TUNNEL_KEY_BYTES
from gdp.errors import DropReason, StatementError
from gdp.names import Name
from gdp.trust.domain import Policy

__all__ = ["CANDIDATES_MAX", "RECORD_MAX_BYTES", "UPLINKS_MAX", "Candidate", "CandidateType", "EndpointRecord"]

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


@dataclass(frozen=True, slots=True, kw_only=True)
class EndpointRecord:
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

    name: Name
    keys: tuple[bytes, ...]
    candidates: tuple[Candidate, ...]
    sequence: int
    until_unix_s: int
    membership: bytes = field(repr=False)
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
        candidates = candidates[:CANDIDATES_MAX]
        body = {
            "k": list(keys[:UPLINKS_MAX]),
            "a": [[each.uplink, each.type.value, each.endpoint.to_wire()] for each in candidates],
            "s": sequence,
            "u": until_unix_s,
            "c": identity.membership,
        }
        wire = identity.sign(StatementType.ENDPOINTS, body)
        return cls(
            name=identity.name,
            keys=keys,
            candidates=candidates,
            sequence=sequence,
            until_unix_s=until_unix_s,
            membership=identity.membership,
            wire=wire,
        )

    @classmethod
    def verified(cls, wire: bytes, policy: Policy, unix_s: float) -> tuple[EndpointRecord, Membership]:
        """Read a record; verify its membership, its signature and that it is not void.

        Raises:
            StatementError: TOO_BIG, MALFORMED, BAD_SIGNATURE, EXPIRED, or as ``Policy.verify_membership``.
        """
        if len(wire) > RECORD_MAX_BYTES:
            raise StatementError(DropReason.TOO_BIG, "endpoint record")
        statement = parse(wire)
        record = cls._from_fields(statement.signer, statement.expect(StatementType.ENDPOINTS), wire)
        member = policy.verify_membership(record.membership, unix_s)
        if member.name != statement.signer:
            raise StatementError(DropReason.BAD_CERTIFICATE, "an endpoint record under another's certificate")
        statement.verify(member.key)
        if record.until_unix_s < unix_s:
            raise StatementError(DropReason.EXPIRED, "endpoint record")
        return record, member

    @classmethod
    def _from_fields(cls, signer: Name, fields: Fields, wire: bytes) -> EndpointRecord:
        keys = tuple(fields.byte_strings("k", UPLINKS_MAX, TUNNEL_KEY_BYTES))
        if not keys:
            raise StatementError(DropReason.MALFORMED, "an endpoint record without a key")
        return cls(
            name=signer,
            keys=keys,
            candidates=tuple(_candidate(each, len(keys)) for each in fields.list_("a", CANDIDATES_MAX)),
            sequence=fields.uint("s"),
            until_unix_s=fields.uint("u"),
            membership=fields.bytes_("c"),
            wire=wire,
        )


def _candidate(value: object, uplinks: int) -> Candidate:
    match value:
        case [int(uplink), str(kind), bytes(endpoint)] if 0 <= uplink < uplinks:
            try:
                return Candidate(uplink, CandidateType(kind), Endpoint.from_wire(endpoint))
            except ValueError as error:
                raise StatementError(DropReason.MALFORMED, "a candidate of an endpoint record") from error
    raise StatementError(DropReason.MALFORMED, "a candidate of an endpoint record")
