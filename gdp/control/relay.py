"""A claim passed on: by the switch that its maker is attached to, or by a RIB to the tier above.

Place: pure. The relay's signer says in which domain the claim's switch stands: its own.
"""

from __future__ import annotations

from dataclasses import dataclass

from gdp.control.query import TRANSIT_MAX
from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.names import Name

__all__ = ["Relay"]


@dataclass(frozen=True, slots=True)
class Relay:
    """A claim or a withdrawal on its way.

    Args:
        statement: what is passed on, signed by its maker.
        transit: domains through which the signer's domain lets its traffic pass.
        membership: the signer's certificate, DER.
    """

    statement: bytes
    transit: tuple[Name, ...]
    membership: bytes

    def to_wire(self, signer: Name, key: SigningKey) -> bytes:
        """Return the signed statement."""
        body = {"q": self.statement, "x": list(self.transit[:TRANSIT_MAX]), "c": self.membership}
        return sign(StatementType.RELAY, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Relay:
        """Read a parsed statement's body.

        Raises:
            StatementError: MALFORMED.
        """
        return cls(fields.bytes_("q"), tuple(fields.names("x", TRANSIT_MAX)), fields.bytes_("c"))
