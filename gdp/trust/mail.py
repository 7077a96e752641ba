"""Mail: a small message from one member of a domain to another, signed by its sender.

Sans-I/O. The enrolment server keeps mail until its recipient fetches it. The content is opaque to the server; what must
stay secret is sealed by the sender, as the secrets of a delegation are.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from gdp.crypto.certificates import Unverified
from gdp.crypto.identity import Identity
from gdp.crypto.statements import StatementType, parse
from gdp.errors import DropReason, LocalError, StatementError
from gdp.names import Name

__all__ = ["MAIL_BODY_MAX_BYTES", "MAIL_KIND_MAX_CHARS", "Mail"]

MAIL_BODY_MAX_BYTES: Final = 12 << 10
MAIL_KIND_MAX_CHARS: Final = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class Mail:
    """A message whose sender's signature holds; the sender's membership is verified by who reads it.

    Args:
        sender: its certificate, whose issuer has not been verified.
        kind: lower-case words joined by ``-``, such as ``delegation``.
        sent_unix_ms: by the sender's clock.
    """

    sender: Unverified
    to: Name
    kind: str
    body: bytes = field(repr=False)
    sent_unix_ms: int
    wire: bytes = field(repr=False)

    @staticmethod
    def make(identity: Identity, to: Name, kind: str, body: bytes, unix_s: float) -> bytes:
        """Return the signed statement. Raises ``LocalError``: kind or body are out of bounds."""
        if not _is_kind(kind) or len(body) > MAIL_BODY_MAX_BYTES:
            raise LocalError(
                f"a mail has a kind such as 'delegation' and at most {MAIL_BODY_MAX_BYTES} bytes, not {len(body)}"
            )
        fields = {"c": identity.membership, "to": to, "k": kind, "b": body, "s": int(unix_s * 1000)}
        return identity.sign(StatementType.MAIL, fields)

    @classmethod
    def from_wire(cls, wire: bytes) -> Mail:
        """Read a mail and verify its sender's signature.

        Raises:
            StatementError: MALFORMED, BAD_CERTIFICATE, WRONG_NAME or BAD_SIGNATURE.
        """
        statement = parse(wire)
        fields = statement.expect(StatementType.MAIL)
        sender = Unverified.from_wire(fields.bytes_("c"))
        if sender.subject.name != statement.signer:
            raise StatementError(DropReason.BAD_CERTIFICATE, "a mail under another's certificate")
        kind, body = fields.text("k", MAIL_KIND_MAX_CHARS), fields.bytes_("b")
        if not _is_kind(kind) or len(body) > MAIL_BODY_MAX_BYTES:
            raise StatementError(DropReason.MALFORMED, "kind or body of a mail")
        statement.verify(sender.key)
        return cls(sender=sender, to=fields.name("to"), kind=kind, body=body, sent_unix_ms=fields.uint("s"), wire=wire)


def _is_kind(text: str) -> bool:
    plain = text.replace("-", "")
    return 0 < len(text) <= MAIL_KIND_MAX_CHARS and plain.isascii() and plain.isalnum() and text == text.lower()
