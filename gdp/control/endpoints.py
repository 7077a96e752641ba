"""Endpoints of tunnels: where a node can be reached across IP networks, as a switch's signed record states it.

Sans-I/O. A tunnel is VXLAN (RFC 7348) inside WireGuard. Its inner IPv6 address is a unique local one (RFC 4193) that
follows from the node's name, so it needs no configuration, and two nodes never share it by mistake.
A record names the WireGuard key of each uplink and the candidates at which it may answer, as ICE has them (RFC 8445,
section 5.1). Records travel in enrolments, in files and through the RIB.

The RIBs of one domain equalise a set of records. Its keys are names of switches, its ranks the sequences of records. A
switch requests the records of switches by their whole names, each with the line of the record that it has. A RIB
requests in the same way the switch's own record, so that a publication needs no acknowledgement of its own.
"""

from __future__ import annotations

import hashlib
import ipaddress
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Annotated, Final, NamedTuple

from gdp.crypto.certificates import Membership
from gdp.crypto.identity import Identity
from gdp.crypto.schema import CERTIFICATE, Body, Keyed, many, mapped, octets, one_of, row, uint
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.crypto.tunnel_key import TUNNEL_KEY_BYTES
from gdp.errors import DropReason, LocalError, StatementError
from gdp.names import Name
from gdp.trust.domain import Policy

ENDPOINTS: Final = b"endpoints"  # name of the set that RIBs equalise
ENDPOINT_NAMES_MAX: Final = 64  # in one request of a switch
_LEASE_BYTES: Final = 4  # of an item of that set
CANDIDATES_MAX: Final = 16
UPLINKS_MAX: Final = 4
RECORD_MAX_BYTES: Final = 4 << 10
_PORT_MAX: Final = 65_535
_ULA: Final = b"\xfd"  # RFC 4193, section 3.1, locally assigned
_ADDRESS_BYTES: Final = 16
_PORT_BYTES: Final = 2
ENDPOINT_MAX_BYTES: Final = _ADDRESS_BYTES + _PORT_BYTES
_VNI_BYTES: Final = 3
_PRIVATE: Final = tuple(  # RFC 1918, RFC 6598
    ipaddress.ip_network(each) for each in ("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "100.64.0.0/10")
)


class Endpoint(NamedTuple):
    """A UDP or TCP endpoint.

    Attributes:
        address: numeric, IPv4 or IPv6, in the form of ``ipaddress``.
        port: 1 to 65,535.
    """

    address: str
    port: int

    @classmethod
    def from_text(cls, text: str) -> Endpoint:
        """Read ``192.0.2.1:51820`` or ``[2001:db8::1]:51820``. Raises ``LocalError``: not of this form."""
        host, colon, port = text.rpartition(":")
        is_bracketed = host.startswith("[") and host.endswith("]")
        try:
            address = ipaddress.ip_address(host[1:-1] if is_bracketed else host)
            number = int(port) if port.isascii() and port.isdecimal() else 0
        except ValueError as error:
            raise LocalError(f"expected address:port, not {text!r}") from error
        if not colon or is_bracketed is not (address.version == 6) or not 0 < number <= _PORT_MAX:
            raise LocalError(f"expected address:port, not {text!r}")
        return cls(str(address), number)

    def to_text(self) -> str:
        """Return the form that ``from_text`` reads."""
        return f"[{self.address}]:{self.port}" if ":" in self.address else f"{self.address}:{self.port}"

    @classmethod
    def from_wire(cls, wire: bytes) -> Endpoint:
        """Read 6 bytes (IPv4) or 18 (IPv6), the port last. Raises ``ValueError``: not of this form."""
        port = int.from_bytes(wire[-_PORT_BYTES:], "big")
        address = ipaddress.ip_address(wire[:-_PORT_BYTES])
        if not port:
            raise ValueError("port 0")
        return cls(str(address), port)

    @property
    def is_private(self) -> bool:
        """Whether the address is of private IPv4 networks, so that it has a meaning in its own network only."""
        address = ipaddress.ip_address(self.address)
        return any(address in each for each in _PRIVATE)

    def to_wire(self) -> bytes:
        """Return the bytes that ``from_wire`` reads."""
        return ipaddress.ip_address(self.address).packed + self.port.to_bytes(_PORT_BYTES, "big")


def inner_address(name: Name, uplink: int = 0) -> str:
    """Return the node's IPv6 address inside its tunnels; each of several uplinks has its own."""
    digest = hashlib.sha256(b"gdp-tunnel-address-1" + bytes([uplink]) + name).digest()
    return str(ipaddress.IPv6Address(_ULA + digest[: _ADDRESS_BYTES - len(_ULA)]))


def tunnel_vni(one: str, other: str) -> int:
    """Return the VXLAN network identifier of a tunnel between two inner addresses, the same at both ends."""
    packed = sorted(ipaddress.IPv6Address(each).packed for each in (one, other))
    digest = hashlib.sha256(b"gdp-tunnel-vni-1" + b"".join(packed)).digest()
    return int.from_bytes(digest[:_VNI_BYTES], "big") or 1


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
