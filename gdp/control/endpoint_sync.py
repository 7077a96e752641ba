"""Set of endpoint records that RIBs of one domain equalise, and of which switches get what they want.

Sans-I/O. Its keys are names of switches, its ranks the sequences of records. A switch requests the records of switches
by their whole names, each with the line of the record that it has. A RIB requests in the same way the switch's own
record, so that a publication needs no acknowledgement of its own.
"""

from __future__ import annotations

from typing import Final

from gdp.errors import DropReason, StatementError

ENDPOINTS: Final = b"endpoints"
ENDPOINT_NAMES_MAX: Final = 64  # in one request of a switch
_LEASE_BYTES: Final = 4


def item_of(record: bytes, lease_s: float) -> bytes:
    """Return the item of a record: what is left of its lease (ms, 4 bytes), and the signed record."""
    return int(lease_s * 1_000).to_bytes(_LEASE_BYTES, "big") + record


def record_in(item: bytes) -> tuple[bytes, float]:
    """Return the record in an item, and what is left of its lease, in seconds. Raises ``StatementError``: MALFORMED."""
    if len(item) <= _LEASE_BYTES:
        raise StatementError(DropReason.MALFORMED, "an item without a record")
    return item[_LEASE_BYTES:], int.from_bytes(item[:_LEASE_BYTES], "big") / 1_000
