"""Statements between nodes and RIBs: advertisements that are relayed and acknowledged, queries and their responses.

Sans-I/O. A switch relays advertisements and revocations of its own domain. A RIB names the domain of each advertisement
that it forwards to the tier above.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Final

from gdp.crypto.identity import Identity
from gdp.crypto.schema import CERT, NAME, REASON, STATEMENT, Body, Keyed, many, number, octets, or_empty, uint
from gdp.crypto.statements import StatementType
from gdp.errors import DropReason
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


@dataclass(frozen=True, slots=True)
class RelayedStatement(Body):
    """An advertisement, a withdrawal or a revocation that is forwarded.

    Args:
        statement: the forwarded statement, signed by its maker.
        transit: domains through which the domain of the advertisement's switch lets its traffic pass.
        membership: the signer's certificate, DER.
        domain: domain of the advertisement's switch; None: the signer's domain.
    """

    TYPE = StatementType.RELAY
    statement: Annotated[bytes, Keyed("q", STATEMENT)]
    transit: Annotated[tuple[Name, ...], Keyed("x", many(NAME, TRANSIT_MAX))]
    membership: Annotated[bytes, Keyed("c", CERT)]
    domain: Annotated[Name | None, Keyed("d", or_empty(NAME, None))] = None


def relayed(statement: bytes, switch: Identity, transit: Iterable[Name]) -> bytes:
    """Return an advertisement or withdrawal, relayed by the switch to which its node is attached.

    ``transit`` is that of the switch's domain.
    """
    return RelayedStatement(statement, tuple(sorted(transit)), switch.membership).to_wire(switch.name, switch.key)


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
