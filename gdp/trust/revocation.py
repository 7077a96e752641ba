"""Revocation: who issued a certificate says that it no longer counts.

Sans-I/O. A revocation names the SHA-256 of what was signed, not of the whole certificate: anybody can turn an ECDSA
signature into a second valid one, and that must not bring a revoked certificate back. It counts only against what the
same key issued (or against any link of a chain, when the name's owner says so), so a stranger can revoke nothing but
his own. ``revocations.py`` keeps them.
"""

from __future__ import annotations

from dataclasses import dataclass

from gdp.crypto.keys import PublicKey, SigningKey
from gdp.crypto.statements import Statement, StatementType, sign
from gdp.crypto.subject import Subject

__all__ = ["Revocation"]


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
    def read(cls, statement: Statement) -> Revocation:
        """Read a parsed statement; its signature is not looked at, see ``verify``.

        Raises:
            StatementError: MALFORMED or WRONG_NAME.
        """
        fields = statement.expect(StatementType.REVOKE)
        issuer = Subject.from_fields(fields, statement.signer)
        return cls(fields.bytes_("cert", 32), issuer, fields.uint("until"))

    def verify(self, statement: Statement) -> None:
        """Return if the issuer signed the statement that this was read from.

        Raises:
            StatementError: MALFORMED, the issuer's key is none, or BAD_SIGNATURE.
        """
        statement.verify(PublicKey.from_compressed(self.issuer.owner_key))

    @classmethod
    def from_statement(cls, statement: Statement) -> Revocation:
        """Read and verify a parsed statement; it carries what proves its signer.

        Raises:
            StatementError: MALFORMED, WRONG_NAME or BAD_SIGNATURE.
        """
        revocation = cls.read(statement)
        revocation.verify(statement)
        return revocation
