"""Revocation: the issuer of a certificate ends it early.

Sans-I/O. A revocation names the SHA-256 of the signed part, not of the whole certificate. Any observer can turn an
ECDSA signature into a second valid one, and that must not restore a revoked certificate. It counts only against
certificates of the same issuer (or against any link of a chain, when the name's owner signs it). So an outsider can
revoke only its own certificates. ``revocations.py`` stores them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from gdp.crypto.keys import PublicKey, SigningKey
from gdp.crypto.schema import Body, Keyed, octets, uint
from gdp.crypto.statements import Statement, StatementType
from gdp.crypto.subject import SUBJECT, Subject


@dataclass(frozen=True, slots=True)
class Revocation(Body):
    """One revoked certificate.

    Args:
        fingerprint: SHA-256 of the signed part: ``Membership.fingerprint``, ``AdCert.fingerprint``, ...
        issuer: the revoking issuer: a domain, the name (for its owner) or the node that issued it.
        until_unix_s: when the certificate would have expired.
    """

    TYPE = StatementType.REVOKE
    fingerprint: Annotated[bytes, Keyed("cert", octets(32))]
    issuer: Annotated[Subject, SUBJECT]
    until_unix_s: Annotated[int, Keyed("until", uint())]

    @staticmethod
    def make(key: SigningKey, issuer: Subject, fingerprint: bytes, until_unix_s: int) -> bytes:
        """Return the signed statement; ``key`` must be the issuer's."""
        return Revocation(fingerprint, issuer, until_unix_s).to_wire(issuer.name, key)

    @classmethod
    def read(cls, statement: Statement) -> Revocation:
        """Read a parsed statement; its signature is not checked, see ``verify``.

        Raises:
            StatementError: MALFORMED or WRONG_NAME.
        """
        revocation = cls.from_fields(statement.expect(cls.TYPE))
        revocation.issuer.expect(statement.signer)
        return revocation

    def verify(self, statement: Statement) -> None:
        """Return if the issuer signed the statement that this was read from.

        Raises:
            StatementError: MALFORMED, the issuer's key is invalid, or BAD_SIGNATURE.
        """
        statement.verify(PublicKey.from_compressed(self.issuer.owner_key))

    @classmethod
    def from_statement(cls, statement: Statement) -> Revocation:
        """Read and verify a parsed statement; it carries its signer's proof.

        Raises:
            StatementError: MALFORMED, WRONG_NAME or BAD_SIGNATURE.
        """
        revocation = cls.read(statement)
        revocation.verify(statement)
        return revocation
