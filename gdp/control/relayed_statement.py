"""Relayed statement: an advertisement or a revocation, forwarded by its node's switch, or by a RIB to the tier above.

Sans-I/O. A switch relays advertisements of its own domain; a RIB names the domain of each advertisement that it
forwards to the tier above.
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

__all__ = ["RelayedStatement", "relayed"]


@dataclass(frozen=True, slots=True)
class RelayedStatement:
    """An advertisement, a withdrawal or a revocation that is forwarded.

    Args:
        statement: the forwarded statement, signed by its maker.
        transit: domains through which the domain of the advertisement's switch lets its traffic pass.
        membership: the signer's certificate, DER.
        domain: domain of the advertisement's switch; None: the signer's domain.
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
    def from_fields(cls, fields: Fields) -> RelayedStatement:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        domain = fields.name("d") if fields.bytes_("d") else None
        return cls(fields.bytes_("q"), tuple(fields.names("x", TRANSIT_MAX)), fields.bytes_("c"), domain)


def relayed(statement: bytes, switch: Identity, transit: Iterable[Name]) -> bytes:
    """Return an advertisement or withdrawal, relayed by the switch to which its node is attached.

    ``transit`` is that of the switch's domain.
    """
    return RelayedStatement(statement, tuple(sorted(transit)), switch.membership).to_wire(switch.name, switch.key)
