"""Revocation digests of neighbours, and requests for missing revocations.

Sans-I/O. Only revocations of trusted domains are compared; ``revocation_sync.py`` decides what is sent when.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from gdp.control.hello import ECHO_BYTES
from gdp.crypto.schema import NAME, NAME_OR_ZERO, Body, Form, Keyed, joined, many, octets, or_empty, row, uint
from gdp.crypto.statements import StatementType
from gdp.errors import DropReason, StatementError
from gdp.limits import CONTROL_MAX_BYTES
from gdp.names import ZERO, Name
from gdp.trust.revocations import BUCKETS, ID_BYTES

__all__ = ["DOMAINS_MAX", "IDS_MAX", "Lacking", "Revoked"]

DOMAINS_MAX: Final = 128
IDS_MAX: Final = 1_500  # 12,000 bytes: a statement has at most 16 KiB


_DOMAIN: Final[Form[tuple[Name, int, bytes]]] = row(lambda *each: each, NAME_OR_ZERO, uint(), octets(ID_BYTES))
_BUCKETS: Final = joined(1, lambda each: each[0], lambda number: bytes([number]), BUCKETS)


@dataclass(frozen=True, slots=True)
class Revoked(Body):
    """Digests of the revocations that the sender keeps.

    Args:
        session: echo of the receiver's port (``echo_of``).
        sequence: rises with every statement of the sender about revocations.
        domains: trusted domain, number of its revocations, digest of these.
        domain: of ``hashes``; ``ZERO``: there are none.
        hashes: digests of this domain's 256 buckets, or empty.
    """

    TYPE = StatementType.REVOKED
    session: Annotated[bytes, Keyed("i", octets(ECHO_BYTES))]
    sequence: Annotated[int, Keyed("s", uint())]
    domains: Annotated[tuple[tuple[Name, int, bytes], ...], Keyed("p", many(_DOMAIN, DOMAINS_MAX))]
    domain: Annotated[Name, Keyed("d", or_empty(NAME, ZERO))] = ZERO
    hashes: Annotated[tuple[bytes, ...], Keyed("h", joined(ID_BYTES, bytes, bytes, BUCKETS))] = ()

    def check(self) -> None:
        """Return if there is a hash for each bucket of a domain. Raises ``StatementError``: MALFORMED."""
        if len(self.hashes) != (0 if self.domain == ZERO else BUCKETS):
            raise StatementError(DropReason.MALFORMED, "hashes of revocations")


@dataclass(frozen=True, slots=True)
class Lacking(Body):
    """A request for what the sender lacks of a domain's revocations.

    Args:
        session, sequence: as in ``Revoked``.
        domain: the revoking domain.
        buckets: first bytes of the fingerprints that are requested; empty: all.
        ids: those of them that the sender has, at most ``IDS_MAX``.
    """

    TYPE = StatementType.LACKING
    session: Annotated[bytes, Keyed("i", octets(ECHO_BYTES))]
    sequence: Annotated[int, Keyed("s", uint())]
    domain: Annotated[Name, Keyed("d", NAME)]
    buckets: Annotated[tuple[int, ...], Keyed("b", _BUCKETS)]
    ids: Annotated[tuple[bytes, ...], Keyed("k", joined(ID_BYTES, bytes, bytes, CONTROL_MAX_BYTES))]

    def check(self) -> None:
        """Return if each bucket stands once. Raises ``StatementError``: MALFORMED."""
        if len(set(self.buckets)) < len(self.buckets):
            raise StatementError(DropReason.MALFORMED, "what is lacking")
