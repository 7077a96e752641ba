"""Query for endpoint records at a RIB, and its response.

Sans-I/O. A switch names the switches whose records it wants, each with the sequence that it has already, and watches
them. A response also states which record of the receiver itself the RIB keeps, so that a publication needs no
acknowledgement of its own.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from gdp.control.endpoint_record import RECORD_MAX_BYTES
from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.errors import DropReason, StatementError
from gdp.limits import CONTROL_MAX_BYTES, LEASE_MAX_S, RECORD_OVERHEAD_BYTES
from gdp.names import NAME_BYTES, ZERO, Name

__all__ = ["ENDPOINT_NAMES_MAX", "EndpointQuery", "EndpointResponse", "batches"]

ENDPOINT_NAMES_MAX: Final = 64  # in one query
RECORDS_MAX: Final = 64  # in one response
_SEQUENCE_BYTES: Final = 8
_TAKEN: Final = 255
_HEAD_BYTES: Final = 330  # COSE, keys, heads, sequence number and signature


@dataclass(frozen=True, slots=True)
class EndpointQuery:
    """Query for the endpoint records of switches, and a watch of them for ``watch_s`` seconds.

    Args:
        known: each switch, and the sequence of its record that the sender has; 0: none. Empty: every record of the
            domain, which only a RIB of that domain may request.
    """

    known: tuple[tuple[Name, int], ...]
    watch_s: float

    def to_wire(self, signer: Name, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement."""
        names = [name + sequence.to_bytes(_SEQUENCE_BYTES, "big") for name, sequence in self.known[:ENDPOINT_NAMES_MAX]]
        body = {"n": names, "w": float(self.watch_s), "c": membership}
        return sign(StatementType.ENDPOINTS_QUERY, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> EndpointQuery:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        items = fields.byte_strings("n", ENDPOINT_NAMES_MAX, NAME_BYTES + _SEQUENCE_BYTES)
        known = tuple((Name(item[:NAME_BYTES]), int.from_bytes(item[NAME_BYTES:], "big")) for item in items)
        if any(name == ZERO for name, _ in known):
            raise StatementError(DropReason.MALFORMED, "a query for the endpoints of no switch")
        return cls(known, fields.number("w", 0, LEASE_MAX_S))


@dataclass(frozen=True, slots=True, kw_only=True)
class EndpointResponse:
    """Endpoint records of other switches, and what the RIB keeps of the receiver.

    Args:
        records: signed by their switches, for the receiver to verify.
        kept_sequence: of the receiver's own record that the RIB keeps; 0: none.
        refused: why the RIB refused the receiver's last record; None: it did not.
    """

    records: tuple[bytes, ...] = ()
    kept_sequence: int = 0
    refused: DropReason | None = None

    def to_wire(self, signer: Name, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement. Raises ``LocalError``: it does not fit; a batch of ``batches`` does."""
        body = {
            "e": list(self.records),
            "s": self.kept_sequence,
            "r": _TAKEN if self.refused is None else int(self.refused),
            "c": membership,
        }
        return sign(StatementType.ENDPOINTS_ANSWER, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> EndpointResponse:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        reason = fields.uint("r", _TAKEN)
        try:
            refused = None if reason == _TAKEN else DropReason(reason)
        except ValueError:
            refused = DropReason.MALFORMED  # a reason of a later version is a refusal all the same
        records = fields.byte_strings("e", RECORDS_MAX)
        if any(len(each) > RECORD_MAX_BYTES for each in records):
            raise StatementError(DropReason.TOO_BIG, "endpoint record")
        return cls(records=tuple(records), kept_sequence=fields.uint("s"), refused=refused)


def batches(records: Iterable[bytes], membership: bytes) -> list[tuple[bytes, ...]]:
    """Return the records in groups that each fit into one response with the signer's certificate."""
    capacity = CONTROL_MAX_BYTES - RECORD_OVERHEAD_BYTES - _HEAD_BYTES - len(membership)
    groups: list[tuple[bytes, ...]] = []
    group: list[bytes] = []
    used = 0
    for record in records:
        cost = len(record) + 3
        if group and (used + cost > capacity or len(group) >= RECORDS_MAX):
            groups.append(tuple(group))
            group, used = [], 0
        group.append(record)
        used += cost
    return [*groups, tuple(group)] if group else groups
