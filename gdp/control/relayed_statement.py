"""Relayed statement: an advertisement or a revocation, forwarded by its node's switch, or by a RIB to the tier above.

Sans-I/O. A switch relays advertisements of its own domain; a RIB names the domain of each advertisement that it
forwards to the tier above.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from gdp.control.query import TRANSIT_MAX
from gdp.crypto.identity import Identity
from gdp.crypto.schema import CERT, NAME, STATEMENT, Body, Keyed, many, or_empty
from gdp.crypto.statements import StatementType
from gdp.names import Name


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
