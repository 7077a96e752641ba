"""Query to a RIB, and its responses: one for each advertiser of the name, one that there is none, or "unknown".

Sans-I/O.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from gdp.crypto.schema import NAME, STATEMENT, Body, Keyed, many, number, octets, or_empty, uint
from gdp.crypto.statements import StatementType
from gdp.intervals import LEASE_MAX_S
from gdp.limits import COST_UNREACHABLE
from gdp.names import Name
from gdp.trust.revocations import ID_BYTES

TRANSIT_MAX: Final = 64


@dataclass(frozen=True, slots=True)
class Query(Body):
    """Query for the advertisers of ``name``; with ``watch_s`` above zero also a watch for that time.

    Args:
        revoked: digest of the revocations of the name's owner that the sender has; the RIB sends all if its own
            differs. None: revocations do not concern the sender.
    """

    TYPE = StatementType.QUERY
    name: Annotated[Name, Keyed("n", NAME)]
    watch_s: Annotated[float, Keyed("w", number(0, LEASE_MAX_S))]
    revoked: Annotated[bytes | None, Keyed("v", or_empty(octets(ID_BYTES), None), absent=None)] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Response(Body):
    """One advertiser of a name, none, or unknown: the RIB could not ask the tier above.

    Args:
        advertiser: node that advertises it; equal to ``name`` with an empty ``advertisement`` when no node does, or the
            RIB does not know.
        advertisement: signed by the advertiser, for the receiver to verify; empty: it ended, or there is none.
        domain: where it is attached.
        transit: domains through which that domain lets its traffic pass.
        lease_s: of the location, or of a negative response; 0: the advertisement ended, or the RIB does not know.
        sequence: of the newest advertisement that ended; a receiver that knows a newer one ignores this response.
        cost: of the path to the advertiser's switch, from that of a reader that wants costs.
    """

    TYPE = StatementType.ANSWER
    name: Annotated[Name, Keyed("n", NAME)]
    advertiser: Annotated[Name, Keyed("a", NAME)]
    advertisement: Annotated[bytes, Keyed("q", STATEMENT)]
    domain: Annotated[Name, Keyed("d", NAME)]
    transit: Annotated[tuple[Name, ...], Keyed("x", many(NAME, TRANSIT_MAX))]
    lease_s: Annotated[float, Keyed("l", number(0, LEASE_MAX_S))]
    sequence: Annotated[int, Keyed("s", uint())] = 0
    cost: Annotated[int | None, Keyed("k", uint(COST_UNREACHABLE), absent=None, is_omitted=True)] = None

    @property
    def is_negative(self) -> bool:
        """Return whether no node advertises the name."""
        return not self.advertisement and self.advertiser == self.name and not self.is_unknown

    @property
    def is_unknown(self) -> bool:
        """Return whether the RIB could not ask those that would know."""
        return self.advertiser == self.name and not (self.advertisement or self.lease_s or self.sequence)
