"""Refresh of joins by their numbers, and the reply that names the unknown ones.

Sans-I/O. Source: RFC 2961, section 5 (the Summary Refresh of RSVP, and its MESSAGE_ID_NACK). A join has several frames:
two advertisements with all their certificates. While nothing in it changes, its number alone renews it. One refresh
renews the joins of many trees. A receiver that does not know a number says so, and gets the whole join again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Final

from gdp.control.hello import ECHO_BYTES, NONCE_BYTES
from gdp.crypto.schema import FLAG, Body, Keyed, joined, octets, uint
from gdp.crypto.statements import StatementType
from gdp.errors import DropReason, StatementError

NUMBERS_MAX: Final = 128  # of one statement, so that it fits into a frame of Ethernet's MTU
_NUMBERS: Final = joined(
    8, partial(int.from_bytes, byteorder="big"), partial(int.to_bytes, length=8, byteorder="big"), NUMBERS_MAX
)


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinRefresh(Body):
    """Numbers of joins that stand, or (``is_reply``) of those in a refresh that the receiver does not have.

    Args:
        numbers: ``sequence`` of each join, at most ``NUMBERS_MAX``.
        session: echo of the receiver's port (``echo_of``).
        sender_session: nonce of the sender's port.
        sequence: rises with every join, leave and refresh of the sender within its session.
    """

    TYPE = StatementType.JOIN_REFRESH
    numbers: Annotated[tuple[int, ...], Keyed("k", _NUMBERS)]
    session: Annotated[bytes, Keyed("i", octets(ECHO_BYTES))]
    sender_session: Annotated[bytes, Keyed("o", octets(NONCE_BYTES))]
    sequence: Annotated[int, Keyed("s", uint())]
    is_reply: Annotated[bool, Keyed("u", FLAG, absent=False, is_omitted=True)] = False

    def check(self) -> None:
        """Return if there are numbers. Raises ``StatementError``: MALFORMED."""
        if not self.numbers:
            raise StatementError(DropReason.MALFORMED, "no numbers of joins")
