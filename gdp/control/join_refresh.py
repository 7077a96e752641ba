"""Refresh of joins by their numbers, and the reply that names the unknown ones.

Sans-I/O. Source: RFC 2961, section 5 (the Summary Refresh of RSVP, and its MESSAGE_ID_NACK). A join has several frames:
two advertisements with all their certificates. While nothing in it changes, its number alone renews it. One refresh
renews the joins of many trees. A receiver that does not know a number says so, and gets the whole join again.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

from gdp.control.hello import ECHO_BYTES, NONCE_BYTES
from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.errors import DropReason, StatementError
from gdp.names import Name

__all__ = ["NUMBERS_MAX", "JoinRefresh"]

NUMBERS_MAX: Final = 128  # of one statement, so that it fits into a frame of Ethernet's MTU
_NUMBER: Final = struct.Struct(">Q")


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinRefresh:
    """Numbers of joins that stand, or (``is_reply``) of those in a refresh that the receiver does not have.

    Args:
        numbers: ``sequence`` of each join, at most ``NUMBERS_MAX``.
        session: echo of the receiver's port (``echo_of``).
        sender_session: nonce of the sender's port.
        sequence: rises with every join, leave and refresh of the sender within its session.
    """

    numbers: tuple[int, ...]
    session: bytes
    sender_session: bytes
    sequence: int
    is_reply: bool = False

    def to_wire(self, signer: Name, key: SigningKey) -> bytes:
        """Return the signed statement."""
        body = {
            "i": self.session,
            "o": self.sender_session,
            "s": self.sequence,
            "k": b"".join(map(_NUMBER.pack, self.numbers)),
        }
        return sign(StatementType.JOIN_UNKNOWN if self.is_reply else StatementType.JOIN_REFRESH, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields, *, is_reply: bool = False) -> JoinRefresh:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        packed = fields.bytes_("k")
        if not packed or len(packed) % _NUMBER.size or len(packed) > NUMBERS_MAX * _NUMBER.size:
            raise StatementError(DropReason.MALFORMED, "numbers of joins")
        return cls(
            numbers=tuple(number for (number,) in _NUMBER.iter_unpack(packed)),
            session=fields.bytes_("i", ECHO_BYTES),
            sender_session=fields.bytes_("o", NONCE_BYTES),
            sequence=fields.uint("s"),
            is_reply=is_reply,
        )
