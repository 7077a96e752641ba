"""Neighbour state machine.

Sans-I/O. Source: OSPF (RFC 2328, section 10.1).

::

    (unknown) --heard--> HEARD --echoed--> UP
                 HEARD <--not echoed-- UP        silence or a lost link: gone
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final

from gdp.control.endpoints import Endpoint
from gdp.control.hello import INCARNATION_BYTES, echo_of
from gdp.control.keepalive import KeepaliveSession
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.keys import PublicKey
from gdp.limits import COST_DEFAULT
from gdp.names import Name
from gdp.token_bucket import TokenBucket


class NeighbourState(Enum):
    """States of a neighbour."""

    HEARD = "heard"  # we receive its hellos; it has not shown that it receives ours
    UP = "up"
    GONE = "gone"


class NeighbourEvent(Enum):
    """Events of a neighbour."""

    ONE_WAY = "one-way"  # a hello that does not echo our nonce
    TWO_WAY = "two-way"  # one that does
    SILENCE = "silence"
    LINK_LOST = "link-lost"


_S, _E = NeighbourState, NeighbourEvent
TRANSITIONS: Final[dict[tuple[NeighbourState, NeighbourEvent], NeighbourState]] = {
    (_S.HEARD, _E.ONE_WAY): _S.HEARD,
    (_S.HEARD, _E.TWO_WAY): _S.UP,
    (_S.HEARD, _E.SILENCE): _S.GONE,
    (_S.HEARD, _E.LINK_LOST): _S.GONE,
    (_S.UP, _E.ONE_WAY): _S.HEARD,
    (_S.UP, _E.TWO_WAY): _S.UP,
    (_S.UP, _E.SILENCE): _S.GONE,
    (_S.UP, _E.LINK_LOST): _S.GONE,
    (_S.GONE, _E.ONE_WAY): _S.HEARD,
    (_S.GONE, _E.TWO_WAY): _S.UP,
    (_S.GONE, _E.SILENCE): _S.GONE,
    (_S.GONE, _E.LINK_LOST): _S.GONE,
}


@dataclass(slots=True, kw_only=True)
class Neighbour:
    """The node at the other end of a port, as its verified hellos describe it."""

    name: Name
    role: Role
    domain: Name
    key: PublicKey
    port: int
    mac: bytes
    mtu: int
    nonce: bytes
    sequence: int
    digest: bytes
    heard_s: float  # when its last valid frame came
    state: NeighbourState = NeighbourState.GONE
    cost: int = COST_DEFAULT  # of the link to it: the port's, or the measured one
    candidate: bytes = b""  # nonce of a session that has not proved itself yet
    candidate_sequence: int = -1  # of its last hello
    member: Membership | None = None
    checked_s: float = 0.0  # when its membership was last found valid
    greeted_s: float = 0.0  # when its last hello came
    keepalives: KeepaliveSession | None = None  # while it is up and both ends want them
    lateness_s: float = 0.0  # of this node, in all, when the neighbour was last heard
    incarnation_id: bytes = bytes(INCARNATION_BYTES)
    proof: tuple[bytes, bytes] | None = None  # of a RIB that is attached here: its membership, its RtCert for us
    is_let_go: bool = False  # it is removed at once: its membership was revoked, or an older node has its identity
    refuses_us: bool = False  # its last hello reported that an older node has our identity
    is_proven: bool = False  # its present session has echoed our nonce: it is on this link now
    cookie: bytes = b""  # received from it: it verifies strangers' hellos with one only
    observed: Endpoint | None = None  # ours, as its last hello states it: where it sees this end of a tunnel
    hellos: TokenBucket | None = None  # how many of its hellos are verified, once it is proven

    @property
    def echo(self) -> bytes:
        """Return how we refer to its present session."""
        return echo_of(self.nonce, self.name)
