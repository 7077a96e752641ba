"""What a switch says about its links, flooded to those who compute paths.

Place: pure.
Source: after OSPF (RFC 2328): newest sequence wins, a link counts when both ends name it. Two scopes: ``DOMAIN`` stays
within the trust domain and names every link; ``BORDER`` goes to all domains that accept its signer's. It names the
links that leave the domain, how far the other borders are, and which switches and RIBs are reachable behind it. When a
failure parts a domain, each part is reached through the borders that list it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

from gdp.control.hello import LIFE_BYTES, NONCE_BYTES
from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.errors import DropReason, StatementError
from gdp.limits import FRAME_MAX_BYTES
from gdp.names import Name

__all__ = ["Adjacency", "AttachedRib", "LinkState", "Scope"]

LINKS_MAX: Final = 128
RIBS_MAX: Final = 16
MEMBERS_MAX: Final = 128  # 4.4 kB; of a larger domain the rest is reached through the nearest border
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


class AttachedRib(NamedTuple):
    """A RIB that is attached to a switch.

    Args:
        domain: the RIB's own, which may differ from the switch's.
        session: nonce of its present session with its switch; a restarted or moved RIB has another one.
        life: mark of its life (``LIFE_BYTES``), which tells two nodes with one identity apart.
    """

    name: Name
    domain: Name
    session: bytes
    life: bytes = bytes(LIFE_BYTES)


@dataclass(frozen=True, slots=True)
class LinkState:
    """All that one switch says in one scope."""

    origin: Name
    domain: Name  # of the origin, from its certificate
    scope: Scope
    sequence: int
    links: tuple[Adjacency, ...]
    inside: tuple[Adjacency, ...]  # BORDER only
    ribs: tuple[AttachedRib, ...]  # attached here (DOMAIN), or reachable within this domain (BORDER)
    members: tuple[Name, ...] = ()  # BORDER only: switches of the domain that are reachable within it from here
    life: bytes = bytes(LIFE_BYTES)  # mark of the origin's life
    refused: tuple[Name, ...] = ()  # identities refused at this switch, for an older node has them

    def to_wire(self, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement."""
        body = {
            "o": self.scope.value,
            "s": self.sequence,
            "l": [list(each) for each in self.links[:LINKS_MAX]],
            "i": [list(each) for each in self.inside[:LINKS_MAX]],
            "r": [list(each) for each in self.ribs[:RIBS_MAX]],
            "m": list(self.members[:MEMBERS_MAX]),
            "b": self.life,
            "u": list(self.refused[:RIBS_MAX]),
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
            _ribs(fields),
            tuple(fields.names("m", MEMBERS_MAX)),
            fields.bytes_("b", LIFE_BYTES),
            tuple(fields.names("u", RIBS_MAX)),
        )


def _ribs(fields: Fields) -> tuple[AttachedRib, ...]:
    found = []
    for each in fields.list_("r", RIBS_MAX):
        match each:
            case [bytes(name), bytes(domain), bytes(session), bytes(life)] if (
                len(name) == len(domain) == 32 and len(session) == NONCE_BYTES and len(life) == LIFE_BYTES
            ):
                found.append(AttachedRib(Name(name), Name(domain), session, life))
            case _:
                raise StatementError(DropReason.MALFORMED, "RIB")
    return tuple(found)


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
