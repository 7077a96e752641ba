"""Acknowledgement of an advertisement: accepted, or rejected with a reason."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from gdp.crypto.schema import NAME, REASON, Body, Keyed, uint
from gdp.crypto.statements import StatementType
from gdp.errors import DropReason
from gdp.names import Name


@dataclass(frozen=True, slots=True)
class AdvertiseAck(Body):
    """Reply of a RIB or a switch to an advertisement or a withdrawal: shorter than these, so it cannot amplify.

    Args:
        refused: None when it was accepted.
        sequence: of the advertisement that the sender now holds; one refused as STALE must be resent with a higher
            number.
    """

    TYPE = StatementType.ADVERTISE_ACK
    name: Annotated[Name, Keyed("n", NAME)]
    advertiser: Annotated[Name, Keyed("a", NAME)]
    refused: Annotated[DropReason | None, Keyed("r", REASON)]
    sequence: Annotated[int, Keyed("s", uint())]
