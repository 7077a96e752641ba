"""Link state: a switch's signed description of its links, flooded to the nodes that compute paths.

Sans-I/O. Source: OSPF (RFC 2328): the newest sequence number wins, and a link counts when both ends name it. There are
two scopes. ``DOMAIN`` stays within the trust domain and names every link. ``BORDER`` goes to all domains that accept
its signer's. It names the links that leave the domain, the distance to the other borders, and the switches and RIBs
that are reachable behind it. When a failure partitions a domain, each part is reached through the borders that list it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Annotated, Final, NamedTuple, TypeVar

from gdp.control.hello import INCARNATION_BYTES, NONCE_BYTES
from gdp.crypto.cbor import Value
from gdp.crypto.schema import CERT, FLAG, NAME, STATEMENT, Body, Keyed, many, octets, one_of, row, uint
from gdp.crypto.statements import StatementType
from gdp.limits import CONTROL_MAX_BYTES, FRAME_MAX_BYTES
from gdp.names import Name

LINKS_MAX: Final = 128
RIBS_MAX: Final = 16
MEMBERS_MAX: Final = 128  # 4.4 kB; of a larger domain the rest is reached through the nearest border
COST_MAX: Final = 1 << 24
LINK_KEY_MAX: Final = (1 << 32) - 1
_HEAD_BYTES: Final = 330  # COSE, keys, heads, sequence number, incarnation, time and signature
_LINK_BYTES: Final = 85
_NAME_BYTES: Final = 34
_RIB_BYTES: Final = 110  # in addition to its two certificates

_T = TypeVar("_T")


class Scope(Enum):
    """How far a link state travels."""

    DOMAIN = "domain"
    BORDER = "border"


class Adjacency(NamedTuple):
    """A link to a neighbour, or, in ``inside``, the path to another border of the same domain.

    Args:
        key: distinguishes the links between the same two switches (``link_key``); 0 in ``inside``.
    """

    name: Name
    domain: Name
    cost: int
    mtu: int
    key: int = 0


def link_key(mac: bytes, other_mac: bytes) -> int:
    """Return the key of a link, which both ends compute alike from their two addresses; it has 32 bits.

    It does not depend on other links between the same switches, so that it stays when one of them comes or goes.
    """
    return int.from_bytes(hashlib.sha256(min(mac, other_mac) + max(mac, other_mac)).digest()[:4], "big")


class AttachedRib(NamedTuple):
    """A RIB that is attached to a switch.

    Args:
        domain: the RIB's own, which may differ from the switch's.
        session: nonce of its present session with its switch; a restarted or moved RIB has another one.
        incarnation_id: mark of its incarnation (``INCARNATION_BYTES``); it distinguishes two nodes with one identity.
        membership: its certificate, DER.
        rtcert: the RIB's permission for a switch to attract its traffic.
    """

    name: Name
    domain: Name
    session: bytes
    incarnation_id: bytes = bytes(INCARNATION_BYTES)
    membership: bytes = b""
    rtcert: bytes = b""

    @property
    def cost_bytes(self) -> int:
        """Return the bytes that it occupies in a statement, at most."""
        return _RIB_BYTES + len(self.membership) + len(self.rtcert)


_ADJACENCY: Final = row(Adjacency, NAME, NAME, uint(COST_MAX, 1), uint(FRAME_MAX_BYTES, 1), uint(LINK_KEY_MAX))
_RIB: Final = row(AttachedRib, NAME, NAME, octets(NONCE_BYTES), octets(INCARNATION_BYTES), CERT, STATEMENT)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStateVersion(Body):
    """Which link state of its origin it is; a receiver drops most by these fields alone.

    Args:
        incarnation_id: mark of the origin's incarnation.
        said_unix_s: when it was signed, by the origin's wall clock.
    """

    TYPE = StatementType.LINK_STATE
    scope: Annotated[Scope, Keyed("o", one_of(Scope))]
    sequence: Annotated[int, Keyed("s", uint())]
    incarnation_id: Annotated[bytes, Keyed("b", octets(INCARNATION_BYTES))] = bytes(INCARNATION_BYTES)
    said_unix_s: Annotated[int, Keyed("e", uint())] = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkState(LinkStateVersion):
    """Link state of one switch in one scope.

    Args:
        domain: of the origin, from its certificate.
        inside: BORDER only.
        ribs: attached here (DOMAIN), or reachable within this domain (BORDER).
        members: BORDER only: switches of the domain that are reachable within it from here.
        refused: identities refused at this switch, because an older node has them.
        is_partial: there are members that are not listed.
        is_leaf: from the origin's certificate: no path leads through it.
    """

    origin: Name
    domain: Name
    links: Annotated[tuple[Adjacency, ...], Keyed("l", many(_ADJACENCY, LINKS_MAX))]
    inside: Annotated[tuple[Adjacency, ...], Keyed("i", many(_ADJACENCY, LINKS_MAX))]
    ribs: Annotated[tuple[AttachedRib, ...], Keyed("r", many(_RIB, RIBS_MAX))]
    members: Annotated[tuple[Name, ...], Keyed("m", many(NAME, MEMBERS_MAX))] = ()
    refused: Annotated[tuple[Name, ...], Keyed("u", many(NAME, RIBS_MAX))] = ()
    is_partial: Annotated[bool, Keyed("z", FLAG)] = False
    is_leaf: bool = False

    def fitted(self, membership: bytes) -> LinkState:
        """Return the part of it that fits one statement with the signer's certificate: RIBs and links first."""
        capacity = CONTROL_MAX_BYTES - _HEAD_BYTES - len(membership)
        ribs = _cut(self.ribs[:RIBS_MAX], [each.cost_bytes for each in self.ribs], capacity // 2)
        capacity -= sum(each.cost_bytes for each in ribs)
        links = _cut(self.links[:LINKS_MAX], [_LINK_BYTES] * len(self.links), capacity)
        capacity -= _LINK_BYTES * len(links)
        refused = _cut(self.refused[:RIBS_MAX], [_NAME_BYTES] * len(self.refused), capacity)
        capacity -= _NAME_BYTES * len(refused)
        inside = _cut(self.inside[:LINKS_MAX], [_LINK_BYTES] * len(self.inside), capacity)
        capacity -= _LINK_BYTES * len(inside)
        members = _cut(self.members[:MEMBERS_MAX], [_NAME_BYTES] * len(self.members), capacity)
        return replace(
            self, links=links, inside=inside, ribs=ribs, members=members, refused=refused,
            is_partial=len(members) < len(self.members),
        )  # fmt: skip

    @classmethod
    def from_origin(
        cls, fields: Mapping[str, Value], origin: Name, domain: Name, *, is_leaf: bool = False
    ) -> LinkState:
        """Read a parsed statement's body; role and domain of the origin come from its certificate.

        Of a leaf, links that leave its domain are left out.

        Raises:
            StatementError: MALFORMED.
        """
        found = cls.from_fields(fields, origin=origin, domain=domain, is_leaf=is_leaf)
        return replace(found, links=tuple(each for each in found.links if each.domain == domain)) if is_leaf else found


def _cut(items: tuple[_T, ...], costs: list[int], capacity: int) -> tuple[_T, ...]:
    """Return the first items, as far as their costs fit."""
    kept: list[_T] = []
    for item, cost in zip(items, costs, strict=False):
        capacity -= cost
        if capacity < 0:
            break
        kept.append(item)
    return tuple(kept)
