"""Mail: a small message from one member of a domain to another, signed by its sender.

Sans-I/O. The enrolment server keeps mail until its recipient fetches it. The content is opaque to the server; what must
stay secret is sealed by the sender, as the secrets of a delegation are.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Final

from gdp.crypto.certificates import Unverified
from gdp.crypto.identity import Identity
from gdp.crypto.schema import CERT, NAME, Body, Keyed, octets, text, uint
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.errors import DropReason, LocalError, StatementError
from gdp.names import Name

MAIL_BODY_MAX_BYTES: Final = 12 << 10
MAIL_KIND_MAX_CHARS: Final = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class Mail(Body):
    """A message whose sender's signature holds; the sender's membership is verified by who reads it.

    Args:
        certificate: of the sender.
        kind: lower-case words joined by ``-``, such as ``delegation``.
        sent_unix_ms: by the sender's clock.
    """

    TYPE = StatementType.MAIL
    certificate: Annotated[bytes, Keyed("c", CERT)] = field(repr=False)
    to: Annotated[Name, Keyed("to", NAME)]
    kind: Annotated[str, Keyed("k", text(MAIL_KIND_MAX_CHARS))]
    body: Annotated[bytes, Keyed("b", octets(most=MAIL_BODY_MAX_BYTES))] = field(repr=False)
    sent_unix_ms: Annotated[int, Keyed("s", uint())]
    wire: bytes = field(default=b"", repr=False)

    @property
    def sender(self) -> Unverified:
        """Return the sender's membership, whose issuer has not been verified; costs about 0.1 ms."""
        return Unverified.from_wire(self.certificate)

    @staticmethod
    def make(identity: Identity, to: Name, kind: str, body: bytes, unix_s: float) -> bytes:
        """Return the signed statement. Raises ``LocalError``: kind or body are out of bounds."""
        if not _is_kind(kind) or len(body) > MAIL_BODY_MAX_BYTES:
            raise LocalError(
                f"a mail has a kind such as 'delegation' and at most {MAIL_BODY_MAX_BYTES} bytes, not {len(body)}"
            )
        mail = Mail(certificate=identity.membership, to=to, kind=kind, body=body, sent_unix_ms=int(unix_s * 1000))
        return mail.to_wire(identity.name, identity.key)

    @classmethod
    def from_wire(cls, wire: bytes) -> Mail:
        """Read a mail and verify its sender's signature.

        Raises:
            StatementError: MALFORMED, BAD_CERTIFICATE, WRONG_NAME or BAD_SIGNATURE.
        """
        statement = parse(wire)
        mail = cls.from_statement(statement)
        Unverified.of_signer(mail.certificate, statement)
        return mail

    @classmethod
    def given_by(cls, statement: Statement) -> dict[str, object]:
        """Return the bytes."""
        return {"wire": statement.wire}

    def check(self) -> None:
        """Return if the kind is one. Raises ``StatementError``: MALFORMED."""
        if not _is_kind(self.kind):
            raise StatementError(DropReason.MALFORMED, "kind of a mail")


def _is_kind(word: str) -> bool:
    plain = word.replace("-", "")
    return 0 < len(word) <= MAIL_KIND_MAX_CHARS and plain.isascii() and plain.isalnum() and word == word.lower()
