"""Link state: a switch's signed description of its links, flooded to the nodes that compute paths.

Sans-I/O. Source: OSPF (RFC 2328): the newest sequence number wins, and a link counts when both ends name it. There are
two scopes. ``DOMAIN`` stays within the trust domain and names every link. ``BORDER`` goes to all domains that accept
its signer's. It names the links that leave the domain, the distance to the other borders, and the switches and RIBs
that are reachable behind it. When a failure partitions a domain, each part is reached through the borders that list it.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final, NamedTuple, TypeVar

from gdp.control.hello import INCARNATION_BYTES, NONCE_BYTES
from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.errors import DropReason, StatementError
from gdp.limits import CONTROL_MAX_BYTES, FRAME_MAX_BYTES
from gdp.names import ZERO, Name

__all__ = ["LINK_KEY_MAX", "Adjacency", "AttachedRib", "LinkState", "Scope", "link_key"]

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


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkState:
    """Link state of one switch in one scope."""

    origin: Name
    domain: Name  # of the origin, from its certificate
    scope: Scope
    sequence: int
    links: tuple[Adjacency, ...]
    inside: tuple[Adjacency, ...]  # BORDER only
    ribs: tuple[AttachedRib, ...]  # attached here (DOMAIN), or reachable within this domain (BORDER)
    members: tuple[Name, ...] = ()  # BORDER only: switches of the domain that are reachable within it from here
    incarnation_id: bytes = bytes(INCARNATION_BYTES)  # mark of the origin's incarnation
    refused: tuple[Name, ...] = ()  # identities refused at this switch, because an older node has them
    is_partial: bool = False  # there are members that are not listed
    said_unix_s: int = 0  # when it was signed, by the origin's wall clock
    is_leaf: bool = False  # from the origin's certificate: no path leads through it

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

    def to_wire(self, key: SigningKey, membership: bytes) -> bytes:
        """Return the signed statement. Raises ``LocalError``: it does not fit; ``fitted`` does."""
        body = {
            "o": self.scope.value,
            "s": self.sequence,
            "l": [list(each) for each in self.links],
            "i": [list(each) for each in self.inside],
            "r": [list(each) for each in self.ribs],
            "m": list(self.members),
            "z": self.is_partial,
            "b": self.incarnation_id,
            "u": list(self.refused),
            "e": self.said_unix_s,
            "c": membership,
        }
        return sign(StatementType.LINK_STATE, body, self.origin, key)

    @classmethod
    def from_fields(cls, fields: Fields, origin: Name, domain: Name, *, is_leaf: bool = False) -> LinkState:
        """Read a parsed statement's body; role and domain of the origin come from its certificate.

        Of a leaf, links that leave its domain are left out.

        Raises:
            StatementError: MALFORMED.
        """
        scope = fields.text("o", 8)
        if scope not in ("domain", "border"):
            raise StatementError(DropReason.MALFORMED, "scope")
        return cls(
            origin=origin,
            domain=domain,
            scope=Scope(scope),
            sequence=fields.uint("s"),
            links=tuple(each for each in _adjacencies(fields, "l") if not is_leaf or each.domain == domain),
            inside=_adjacencies(fields, "i"),
            ribs=_ribs(fields),
            members=tuple(fields.names("m", MEMBERS_MAX)),
            incarnation_id=fields.bytes_("b", INCARNATION_BYTES),
            refused=tuple(fields.names("u", RIBS_MAX)),
            is_partial=fields.flag("z"),
            said_unix_s=fields.uint("e"),
            is_leaf=is_leaf,
        )


def _cut(items: tuple[_T, ...], costs: list[int], capacity: int) -> tuple[_T, ...]:
    """Return the first items, as far as their costs fit."""
    kept: list[_T] = []
    for item, cost in zip(items, costs, strict=False):
        capacity -= cost
        if capacity < 0:
            break
        kept.append(item)
    return tuple(kept)


def _ribs(fields: Fields) -> tuple[AttachedRib, ...]:
    found = []
    for each in fields.list_("r", RIBS_MAX):
        match each:
            case [
                bytes(name),
                bytes(domain),
                bytes(session),
                bytes(incarnation_id),
                bytes(membership),
                bytes(rtcert),
            ] if (
                len(name) == len(domain) == 32
                and ZERO not in (name, domain)
                and len(session) == NONCE_BYTES
                and len(incarnation_id) == INCARNATION_BYTES
            ):
                found.append(AttachedRib(Name(name), Name(domain), session, incarnation_id, membership, rtcert))
            case _:
                raise StatementError(DropReason.MALFORMED, "RIB")
    return tuple(found)


def _adjacencies(fields: Fields, key: str) -> tuple[Adjacency, ...]:
    found = []
    for each in fields.list_(key, LINKS_MAX):
        match each:
            case [bytes(name), bytes(domain), int(cost), int(mtu), int(key_)] if (
                len(name) == len(domain) == 32
                and ZERO not in (name, domain)
                and 0 < cost <= COST_MAX
                and 0 < mtu <= FRAME_MAX_BYTES
                and 0 <= key_ <= LINK_KEY_MAX
            ):
                found.append(Adjacency(Name(name), Name(domain), cost, mtu, key_))
            case _:
                raise StatementError(DropReason.MALFORMED, "adjacency")
    return tuple(found)
