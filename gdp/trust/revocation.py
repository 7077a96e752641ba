"""Taking back: who issued a certificate says that it no longer counts.

Place: pure.
A revocation names the SHA-256 of what was signed, not of the whole certificate: anybody can turn an ECDSA signature
into a second valid one, and that must not bring a revoked certificate back. It counts only against what the same key
issued (or against any link of a chain, when the name's owner says so), so a stranger can revoke nothing but his own. It
is kept until the certificate would have run out by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Final

from gdp.crypto.keys import PublicKey, SigningKey
from gdp.crypto.statements import Statement, StatementType, sign
from gdp.crypto.subject import Subject
from gdp.errors import DropReason, StatementError
from gdp.limits import CLOCK_SKEW_S

__all__ = ["REVOCATIONS_MAX", "Revocation", "Revocations"]

REVOCATIONS_MAX: Final = 65_536  # of roots, and again as many of others


@dataclass(frozen=True, slots=True)
class Revocation:
    """One certificate taken back.

    Args:
        fingerprint: SHA-256 of what was signed: ``Membership.fingerprint``, ``AdCert.fingerprint``, ...
        issuer: who takes it back: a domain, the name (for its owner) or the node that issued it.
        until_unix_s: when the certificate would have run out.
    """

    fingerprint: bytes
    issuer: Subject
    until_unix_s: int

    @staticmethod
    def make(key: SigningKey, issuer: Subject, fingerprint: bytes, until_unix_s: int) -> bytes:
        """Return the signed statement; ``issuer`` must be of ``key``."""
        body = {**issuer.to_fields(), "cert": fingerprint, "until": until_unix_s}
        return sign(StatementType.REVOKE, body, issuer.name, key)

    @classmethod
    def from_statement(cls, statement: Statement) -> Revocation:
        """Read and verify a parsed statement; it carries what proves its signer.

        Raises:
            StatementError: MALFORMED, WRONG_NAME or BAD_SIGNATURE.
        """
        fields = statement.expect(StatementType.REVOKE)
        issuer = Subject.from_fields(fields, statement.signer)
        revocation = cls(fields.bytes_("cert", 32), issuer, fields.uint("until"))
        statement.verify(PublicKey.from_compressed(issuer.owner_key))
        return revocation


class Revocations:
    """What has been taken back, bounded: the trusted roots have room of their own that nobody else can fill.

    Args:
        root_keys: compressed keys of the trusted roots.
        maximum: entries of each of the two rooms.
    """

    def __init__(self, root_keys: frozenset[bytes], maximum: int = REVOCATIONS_MAX) -> None:
        self._root_keys = root_keys
        self._maximum = maximum
        self._entries: dict[bytes, int] = {}  # issuer's key || fingerprint: until when
        self._by_age: dict[bool, list[tuple[int, bytes]]] = {True: [], False: []}  # by whether a root's

    def __len__(self) -> int:
        return len(self._entries)

    def trust(self, root_keys: frozenset[bytes]) -> None:
        """Count these as the trusted roots' keys from now on; what is known stays."""
        self._root_keys = root_keys

    def add(self, revocation: Revocation, unix_s: float) -> bool:
        """Remember a verified revocation; return whether it was news.

        Raises:
            StatementError: QUOTA, no room, or EXPIRED, the certificate has run out anyway.
        """
        until = revocation.until_unix_s
        if until + CLOCK_SKEW_S < unix_s:
            raise StatementError(DropReason.EXPIRED, "a revocation of what has run out")
        issuer_key = revocation.issuer.owner_key
        entry = issuer_key + revocation.fingerprint
        if self._entries.get(entry, -1) >= until:
            return False
        by_age = self._by_age[issuer_key in self._root_keys]
        while by_age and by_age[0][0] + CLOCK_SKEW_S < unix_s:
            old_until, old = heappop(by_age)
            if self._entries.get(old) == old_until:
                del self._entries[old]
        if len(by_age) >= self._maximum:
            raise StatementError(DropReason.QUOTA, "revocations")
        self._entries[entry] = until
        heappush(by_age, (until, entry))
        return True

    def has(self, fingerprint: bytes, issuer_key: bytes) -> bool:
        """Return whether the holder of ``issuer_key`` took this certificate back."""
        return issuer_key + fingerprint in self._entries
