"""Query for endpoint records at a RIB, and its response.

Sans-I/O. A switch names the switches whose records it wants, each with the sequence that it has already, and watches
them. A response also states which record of the receiver itself the RIB keeps, so that a publication needs no
acknowledgement of its own.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Final

from gdp.control.endpoint_record import RECORD_MAX_BYTES
from gdp.crypto.schema import REASON, STATEMENT, Body, Keyed, many, number, packed, uint
from gdp.crypto.statements import StatementType
from gdp.errors import DropReason, StatementError
from gdp.limits import CONTROL_MAX_BYTES, LEASE_MAX_S, RECORD_OVERHEAD_BYTES
from gdp.names import NAME_BYTES, ZERO, Name

__all__ = ["ENDPOINT_NAMES_MAX", "EndpointQuery", "EndpointResponse", "batches"]

ENDPOINT_NAMES_MAX: Final = 64  # in one query
RECORDS_MAX: Final = 64  # in one response
_SEQUENCE_BYTES: Final = 8
_HEAD_BYTES: Final = 330  # COSE, keys, heads, sequence number and signature


_KNOWN: Final = packed(
    NAME_BYTES + _SEQUENCE_BYTES,
    lambda item: (Name(item[:NAME_BYTES]), int.from_bytes(item[NAME_BYTES:], "big")),
    lambda known: known[0] + known[1].to_bytes(_SEQUENCE_BYTES, "big"),
)


@dataclass(frozen=True, slots=True)
class EndpointQuery(Body):
    """Query for the endpoint records of switches, and a watch of them for ``watch_s`` seconds.

    Args:
        known: each switch, and the sequence of its record that the sender has; 0: none. Empty: every record of the
            domain, which only a RIB of that domain may request.
    """

    TYPE = StatementType.ENDPOINTS_QUERY
    known: Annotated[tuple[tuple[Name, int], ...], Keyed("n", many(_KNOWN, ENDPOINT_NAMES_MAX))]
    watch_s: Annotated[float, Keyed("w", number(0, LEASE_MAX_S))]

    def check(self) -> None:
        """Return if each is a switch. Raises ``StatementError``: MALFORMED."""
        if any(name == ZERO for name, _ in self.known):
            raise StatementError(DropReason.MALFORMED, "a query for the endpoints of no switch")


@dataclass(frozen=True, slots=True, kw_only=True)
class EndpointResponse(Body):
    """Endpoint records of other switches, and what the RIB keeps of the receiver.

    Args:
        records: signed by their switches, for the receiver to verify.
        kept_sequence: of the receiver's own record that the RIB keeps; 0: none.
        refused: why the RIB refused the receiver's last record; None: it did not.
    """

    TYPE = StatementType.ENDPOINTS_ANSWER
    records: Annotated[tuple[bytes, ...], Keyed("e", many(STATEMENT, RECORDS_MAX))] = ()
    kept_sequence: Annotated[int, Keyed("s", uint())] = 0
    refused: Annotated[DropReason | None, Keyed("r", REASON)] = None

    def check(self) -> None:
        """Return if no record is too long. Raises ``StatementError``: TOO_BIG."""
        if any(len(each) > RECORD_MAX_BYTES for each in self.records):
            raise StatementError(DropReason.TOO_BIG, "endpoint record")


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
