"""Join and leave: a switch's request to the next one towards a publisher, to extend or prune a multicast tree; refresh.

Sans-I/O. Source: PIM-SM (RFC 7761). A recorded join or leave has no effect: each names the present sessions of both
ends and counts up within them. So a restarted sender is accepted at once, independent of its clock.

A join has several frames: two advertisements with all their certificates. While nothing in it changes, its number alone
renews it, and one refresh renews the joins of many trees. A receiver that does not know a number says so, and gets the
whole join again. Source: RFC 2961, section 5 (the Summary Refresh of RSVP, and its MESSAGE_ID_NACK).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Final, NamedTuple

from gdp.control.hello import ECHO_BYTES, NONCE_BYTES
from gdp.control.link_state import LINK_KEY_MAX
from gdp.control.rib_statements import TRANSIT_MAX
from gdp.crypto.schema import (
    FLAG,
    NAME,
    NAME_OR_ZERO,
    STATEMENT,
    Body,
    Keyed,
    joined,
    many,
    mapped,
    number,
    octets,
    row,
    uint,
)
from gdp.crypto.statements import StatementType
from gdp.errors import DropReason, StatementError
from gdp.intervals import LEASE_MAX_S
from gdp.limits import FRAME_MAX_BYTES, PACE_MAX, PATHS_MAX
from gdp.names import ZERO, Name

NUMBERS_MAX: Final = 128  # of one statement, so that it fits into a frame of Ethernet's MTU
_NUMBERS: Final = joined(
    8, partial(int.from_bytes, byteorder="big"), partial(int.to_bytes, length=8, byteorder="big"), NUMBERS_MAX
)
ROUTE_MAX: Final = 32  # links of one path


class RouteLink(NamedTuple):
    """One link of a route: the switch that it leads to, and the key of the link (``link_key``)."""

    name: Name
    key: int


Route = tuple[RouteLink, ...]  # from a switch towards the publisher's, in order


_LINK: Final = row(RouteLink, NAME, uint(LINK_KEY_MAX))
_ALLOWED: Final = mapped(many(NAME, TRANSIT_MAX), frozenset, lambda names: tuple(sorted(names)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Join(Body):
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
        pace: the highest of the branches below; frames of a higher one are for faster readers.
    """

    TYPE = StatementType.JOIN
    topic: Annotated[Name, Keyed("n", NAME)]
    publisher: Annotated[Name, Keyed("p", NAME)]
    switch: Annotated[Name, Keyed("w", NAME)]
    domain: Annotated[Name, Keyed("d", NAME)]
    allowed: Annotated[frozenset[Name], Keyed("x", _ALLOWED)]
    mtu: Annotated[int, Keyed("m", uint(FRAME_MAX_BYTES))]
    lease_s: Annotated[float, Keyed("l", number(0, LEASE_MAX_S))]
    evidence: Annotated[bytes, Keyed("e", STATEMENT)]
    session: Annotated[bytes, Keyed("i", octets(ECHO_BYTES))]
    sequence: Annotated[int, Keyed("s", uint())]
    version: Annotated[int, Keyed("v", uint())] = 0
    backup_for: Annotated[Name, Keyed("b", NAME_OR_ZERO)] = ZERO
    sender_session: Annotated[bytes, Keyed("o", octets(NONCE_BYTES))] = bytes(NONCE_BYTES)
    proof: Annotated[bytes, Keyed("c", STATEMENT)] = b""
    path: Annotated[int, Keyed("a", uint(PATHS_MAX, 1))] = 1
    route: Annotated[Route, Keyed("r", many(_LINK, ROUTE_MAX))] = ()
    pace: Annotated[int, Keyed("q", uint(PACE_MAX), PACE_MAX, is_omitted=True)] = PACE_MAX

    def check(self) -> None:
        """Return if the route has no loop. Raises ``StatementError``: MALFORMED, a switch stands twice."""
        if len({link.name for link in self.route}) < len(self.route):
            raise StatementError(DropReason.MALFORMED, "a route with a loop")


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinRefresh(Body):
    """Numbers of joins that stand, or (``is_reply``) of those in a refresh that the receiver does not have.

    Args:
        numbers: ``sequence`` of each join, at most ``NUMBERS_MAX``.
        session: echo of the receiver's port (``echo_of``).
        sender_session: nonce of the sender's port.
        sequence: rises with every join, leave and refresh of the sender within its session.
    """

    TYPE = StatementType.JOIN_REFRESH
    numbers: Annotated[tuple[int, ...], Keyed("k", _NUMBERS)]
    session: Annotated[bytes, Keyed("i", octets(ECHO_BYTES))]
    sender_session: Annotated[bytes, Keyed("o", octets(NONCE_BYTES))]
    sequence: Annotated[int, Keyed("s", uint())]
    is_reply: Annotated[bool, Keyed("u", FLAG, absent=False, is_omitted=True)] = False

    def check(self) -> None:
        """Return if there are numbers. Raises ``StatementError``: MALFORMED."""
        if not self.numbers:
            raise StatementError(DropReason.MALFORMED, "no numbers of joins")
