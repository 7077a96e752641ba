"""A claim or a revocation passed on: by the switch that its maker is attached to, or by a RIB to the tier above.

Place: pure. A switch speaks for claims of its own domain; a RIB says which domain a claim that it passes up is of.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from gdp.control.query import TRANSIT_MAX
from gdp.crypto.fields import Fields
from gdp.crypto.identity import Identity
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.names import Name

__all__ = ["Relay", "relayed"]


@dataclass(frozen=True, slots=True)
class Relay:
    """A claim, a withdrawal or a revocation on its way.

    Args:
        statement: what is passed on, signed by its maker.
        transit: domains through which the domain of the claim's switch lets its traffic pass.
        membership: the signer's certificate, DER.
        domain: where the claim's switch stands; None: in the signer's domain.
    """

    statement: bytes
    transit: tuple[Name, ...]
    membership: bytes
    domain: Name | None = None

    def to_wire(self, signer: Name, key: SigningKey) -> bytes:
        """Return the signed statement."""
        body = {
            "q": self.statement,
            "x": list(self.transit[:TRANSIT_MAX]),
            "d": self.domain or b"",
            "c": self.membership,
        }
        return sign(StatementType.RELAY, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Relay:
        """Read a parsed statement's body.

        Raises:
            StatementError: MALFORMED.
        """
        domain = fields.name("d") if fields.bytes_("d") else None
        return cls(fields.bytes_("q"), tuple(fields.names("x", TRANSIT_MAX)), fields.bytes_("c"), domain)


def relayed(statement: bytes, switch: Identity, transit: Iterable[Name]) -> bytes:
    """Return a claim or withdrawal of a node attached to a switch, relayed by that; ``transit``: of its domain."""
    return Relay(statement, tuple(sorted(transit)), switch.membership).to_wire(switch.name, switch.key)
