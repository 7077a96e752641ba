"""Pace of a reader's branch: which messages of a best-effort topic its switch is to send it.

Sans-I/O. A publisher states in each frame the pace of the slowest branch that is to get it (``frame/spec.md``). A
reader states to its switch the pace that the publisher gave it; joins bring the highest pace below upstream.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from gdp.control.hello import ECHO_BYTES, NONCE_BYTES
from gdp.crypto.schema import NAME, Body, Keyed, octets, uint
from gdp.crypto.statements import StatementType
from gdp.limits import PACE_MAX
from gdp.names import Name


@dataclass(frozen=True, slots=True, kw_only=True)
class ReaderPace(Body):
    """Pace of one publisher's messages on their way to an attached reader.

    Args:
        pace: frames of a higher one are for faster readers; ``PACE_MAX``: the reader gets all.
        session: echo of the receiver's port (``echo_of``).
        sender_session: nonce of the sender's port.
        sequence: rises with every statement of the sender within its session.
    """

    TYPE = StatementType.PACE
    topic: Annotated[Name, Keyed("n", NAME)]
    publisher: Annotated[Name, Keyed("p", NAME)]
    pace: Annotated[int, Keyed("q", uint(PACE_MAX))]
    session: Annotated[bytes, Keyed("i", octets(ECHO_BYTES))]
    sender_session: Annotated[bytes, Keyed("o", octets(NONCE_BYTES))]
    sequence: Annotated[int, Keyed("s", uint())]
