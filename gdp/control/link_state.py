"""What a switch says about its links, flooded to those who compute paths.

Place: pure.
Source: after OSPF (RFC 2328): newest sequence wins, a link counts when both ends name it. Two scopes: ``DOMAIN`` stays
within the trust domain and names every link; ``BORDER`` goes to all domains that accept its signer's and names only the
links that leave the domain and how far the domain's other borders are.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.errors import DropReason, StatementError
from gdp.limits import FRAME_MAX_BYTES
from gdp.names import Name

__all__ = ["Adjacency", "LinkState", "Scope"]

LINKS_MAX: Final = 128
RIBS_MAX: Final = 16
COST_MAX: Final = 1 << 24


class Scope(Enum):
    """How far a link state travels."""

    DOMAIN = "domain"
    BORDER = "border"


class Adjacency(NamedTuple):
    """A link to a neighbour, or, in ``inside``, the way to another border of the same domain."""

    name: Name
    domain: Name
    cost: int
    mtu: int


@dataclass(frozen=True, slots=True)
class LinkState:
    """All that one switch says in one scope."""

    origin: Name
    domain: Name  # of the origin, from its certificate
    scope: Scope
    sequence: int
    links: tuple[Adjacency, ...]
    inside: tuple[Adjacency, ...]  # BORDER only
    ribs: tuple[Name, ...]  # RIBs attached here (DOMAIN), or reachable in this domain (BORDER)

    def to_wire(self, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement."""
        body = {
            "o": self.scope.value,
            "s": self.sequence,
            "l": [list(each) for each in self.links[:LINKS_MAX]],
            "i": [list(each) for each in self.inside[:LINKS_MAX]],
            "r": list(self.ribs[:RIBS_MAX]),
            "c": membership,
        }
        return sign(StatementType.LINK_STATE, body, self.origin, key)

    @classmethod
    def from_fields(cls, fields: Fields, origin: Name, domain: Name) -> LinkState:
        """Read a parsed statement's body.

        Raises:
            StatementError: MALFORMED.
        """
        scope = fields.text("o", 8)
        if scope not in ("domain", "border"):
            raise StatementError(DropReason.MALFORMED, "scope")
        return cls(
            origin,
            domain,
            Scope(scope),
            fields.uint("s"),
            _adjacencies(fields, "l"),
            _adjacencies(fields, "i"),
            tuple(fields.names("r", RIBS_MAX)),
        )


def _adjacencies(fields: Fields, key: str) -> tuple[Adjacency, ...]:
    found = []
    for each in fields.list_(key, LINKS_MAX):
        match each:
            case [bytes(name), bytes(domain), int(cost), int(mtu)] if (
                len(name) == len(domain) == 32 and 0 < cost <= COST_MAX and 0 < mtu <= FRAME_MAX_BYTES
            ):
                found.append(Adjacency(Name(name), Name(domain), cost, mtu))
            case _:
                raise StatementError(DropReason.MALFORMED, "adjacency")
    return tuple(found)
