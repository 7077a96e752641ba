"""Revocation digests of neighbours, and requests for missing revocations.

Sans-I/O. Only revocations of trusted domains are compared; ``revocation_sync.py`` decides what is sent when.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gdp.control.hello import ECHO_BYTES
from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.errors import DropReason, StatementError
from gdp.names import NAME_BYTES, ZERO, Name
from gdp.trust.revocations import BUCKETS, ID_BYTES

__all__ = ["DOMAINS_MAX", "IDS_MAX", "Lacking", "Revoked"]

DOMAINS_MAX: Final = 128
IDS_MAX: Final = 1_500  # 12,000 bytes: a statement has at most 16 KiB


@dataclass(frozen=True, slots=True)
class Revoked:
    """Digests of the revocations that the sender keeps.

    Args:
        session: echo of the receiver's port (``echo_of``).
        sequence: rises with every statement of the sender about revocations.
        domains: trusted domain, number of its revocations, digest of these.
        domain: of ``hashes``; ``ZERO``: there are none.
        hashes: digests of this domain's 256 buckets, or empty.
    """

    session: bytes
    sequence: int
    domains: tuple[tuple[Name, int, bytes], ...]
    domain: Name = ZERO
    hashes: tuple[bytes, ...] = ()

    def to_wire(self, signer: Name, key: SigningKey) -> bytes:
        """Return the signed statement."""
        body = {
            "i": self.session,
            "s": self.sequence,
            "p": [[name, count, digest] for name, count, digest in self.domains[:DOMAINS_MAX]],
            "d": b"" if self.domain == ZERO else self.domain,
            "h": b"".join(self.hashes),
        }
        return sign(StatementType.REVOKED, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Revoked:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        domain = fields.name("d") if fields.bytes_("d") else ZERO
        joined = fields.bytes_("h", 0 if domain == ZERO else BUCKETS * ID_BYTES)
        return cls(fields.bytes_("i", ECHO_BYTES), fields.uint("s"), _domains(fields), domain, _split(joined))


@dataclass(frozen=True, slots=True)
class Lacking:
    """A request for what the sender lacks of a domain's revocations.

    Args:
        session, sequence: as in ``Revoked``.
        domain: the revoking domain.
        buckets: first bytes of the fingerprints that are requested; empty: all.
        ids: those of them that the sender has, at most ``IDS_MAX``.
    """

    session: bytes
    sequence: int
    domain: Name
    buckets: tuple[int, ...]
    ids: tuple[bytes, ...]

    def to_wire(self, signer: Name, key: SigningKey) -> bytes:
        """Return the signed statement."""
        body = {
            "i": self.session,
            "s": self.sequence,
            "d": self.domain,
            "b": bytes(self.buckets),
            "k": b"".join(self.ids),
        }
        return sign(StatementType.LACKING, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Lacking:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        buckets, ids = fields.bytes_("b"), fields.bytes_("k")
        if len(buckets) > BUCKETS or len(set(buckets)) < len(buckets) or len(ids) % ID_BYTES:
            raise StatementError(DropReason.MALFORMED, "what is lacking")
        return cls(fields.bytes_("i", ECHO_BYTES), fields.uint("s"), fields.name("d"), tuple(buckets), _split(ids))


def _split(joined: bytes) -> tuple[bytes, ...]:
    return tuple(joined[at : at + ID_BYTES] for at in range(0, len(joined), ID_BYTES))


def _domains(fields: Fields) -> tuple[tuple[Name, int, bytes], ...]:
    found = []
    for item in fields.list_("p", DOMAINS_MAX):
        match item:
            case [bytes(name), int(count), bytes(digest)] if (
                len(name) == NAME_BYTES and count >= 0 and not isinstance(count, bool) and len(digest) == ID_BYTES
            ):
                found.append((Name(name), count, digest))
            case _:
                raise StatementError(DropReason.MALFORMED, "digests of revocations")
    return tuple(found)
