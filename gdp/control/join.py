"""Join and leave: a switch's request to the next one towards a publisher, to extend or prune a multicast tree.

Sans-I/O. Source: PIM-SM (RFC 7761). A recorded join or leave has no effect: each names the present sessions of both
ends and counts up within them. So a restarted sender is accepted at once, independent of its clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

from gdp.control.hello import ECHO_BYTES, NONCE_BYTES
from gdp.control.link_state import LINK_KEY_MAX
from gdp.control.query import TRANSIT_MAX
from gdp.crypto.fields import Fields
from gdp.crypto.keys import SigningKey
from gdp.crypto.statements import StatementType, sign
from gdp.errors import DropReason, StatementError
from gdp.limits import FRAME_MAX_BYTES, LEASE_MAX_S, PATHS_MAX
from gdp.names import NAME_BYTES, ZERO, Name

__all__ = ["ROUTE_MAX", "Join", "Route", "RouteLink"]

ROUTE_MAX: Final = 32  # links of one path


class RouteLink(NamedTuple):
    """One link of a route: the switch that it leads to, and the key of the link (``link_key``)."""

    name: Name
    key: int


Route = tuple[RouteLink, ...]  # from a switch towards the publisher's, in order


@dataclass(frozen=True, slots=True, kw_only=True)
class Join:
    """Join of one tree: a topic from one publisher.

    Args:
        switch: the switch to which the publisher is attached.
        domain: of that switch.
        allowed: domains through which both ends let the traffic pass.
        mtu: smallest on the way down from here, in bytes after the Ethernet header.
        lease_s: validity of the branch unless renewed; 0 removes it (LEAVE).
        evidence: the signed advertisement of a reader further down; every switch that forwards a join verifies it.
        session: echo of the receiver's port (``echo_of``), so that no other member can forward the join to it.
        sequence: rises with every join and leave of the sender within its session.
        version: sequence number of ``proof``; the newest decides.
        backup_for: the switch below that has the tree by another path, and wants copies only while that path is broken;
            ``ZERO`` in an ordinary join. Source: the secondary join of RFC 7431.
        sender_session: nonce of the sender's port.
        proof: the signed advertisement of the publisher, which states that it is at ``switch``; empty in a leave.
        path: 1, or 2 for the tree of second copies. Source: ``docs/explanation/two-paths.md``.
        route: what remains of the path that the reader's switch chose; empty: the receiver follows its own.
    """

    topic: Name
    publisher: Name
    switch: Name
    domain: Name
    allowed: frozenset[Name]
    mtu: int
    lease_s: float
    evidence: bytes
    session: bytes
    sequence: int
    version: int = 0
    backup_for: Name = ZERO
    sender_session: bytes = bytes(NONCE_BYTES)
    proof: bytes = b""
    path: int = 1
    route: Route = ()

    def to_wire(self, signer: Name, key: SigningKey) -> bytes:
        """Return the signed statement."""
        body = {
            "n": self.topic,
            "p": self.publisher,
            "w": self.switch,
            "d": self.domain,
            "x": sorted(self.allowed)[:TRANSIT_MAX],
            "m": self.mtu,
            "l": float(self.lease_s),
            "e": self.evidence,
            "i": self.session,
            "s": self.sequence,
            "v": self.version,
            "b": self.backup_for,
            "o": self.sender_session,
            "c": self.proof,
            "a": self.path,
            "r": [list(each) for each in self.route],
        }
        return sign(StatementType.JOIN, body, signer, key)

    @classmethod
    def from_fields(cls, fields: Fields) -> Join:
        """Read a parsed statement's body; a malformed one raises ``StatementError``."""
        return cls(
            topic=fields.name("n"),
            publisher=fields.name("p"),
            switch=fields.name("w"),
            domain=fields.name("d"),
            allowed=frozenset(fields.names("x", TRANSIT_MAX)),
            mtu=fields.uint("m", FRAME_MAX_BYTES),
            lease_s=fields.number("l", 0, LEASE_MAX_S),
            evidence=fields.bytes_("e"),
            session=fields.bytes_("i", ECHO_BYTES),
            sequence=fields.uint("s"),
            version=fields.uint("v"),
            backup_for=fields.optional_name("b"),
            sender_session=fields.bytes_("o", NONCE_BYTES),
            proof=fields.bytes_("c"),
            path=_path(fields),
            route=_route(fields),
        )


def _path(fields: Fields) -> int:
    path = fields.uint("a", PATHS_MAX)
    if not path:
        raise StatementError(DropReason.MALFORMED, "a path of number 0")
    return path


def _route(fields: Fields) -> Route:
    """Return the route. Raises ``StatementError``: MALFORMED, a switch stands twice."""
    found = []
    for each in fields.list_("r", ROUTE_MAX):
        match each:
            case [bytes(name), int(key)] if len(name) == NAME_BYTES and name != ZERO and 0 <= key <= LINK_KEY_MAX:
                found.append(RouteLink(Name(name), key))
            case _:
                raise StatementError(DropReason.MALFORMED, "a link of a route")
    if len({link.name for link in found}) < len(found):
        raise StatementError(DropReason.MALFORMED, "a route with a loop")
    return tuple(found)
