"""Port of the hello protocol: its session, its neighbours, and what hellos on it must carry."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from gdp.control.admission import Admission
from gdp.control.endpoints import Endpoint
from gdp.control.hello import echo_of
from gdp.control.join import Join, JoinRefresh
from gdp.control.link_quality import LinkQuality
from gdp.control.link_state import link_key
from gdp.control.neighbour import Neighbour, NeighbourState
from gdp.control.pace import ReaderPace
from gdp.crypto.certificates import issuer_label
from gdp.crypto.exchange import ExchangeKey
from gdp.errors import DropReason, StatementError
from gdp.limits import COST_AUTO
from gdp.message.replay import ReplayWindow
from gdp.names import Name

STRANGERS_MAX: Final = 8  # on one port; the one silent for longest is evicted
_ADDRESSES_MAX: Final = 96  # of neighbours and former ones, whose frames the data plane keeps apart from strangers'
_CREDIT_MAX_BYTES: Final = 16 << 10
_QUALITIES_MAX: Final = 128  # neighbours and former ones; above all that a port has at once
_ENDED_MAX: Final = 1_024  # sessions of the far ends, remembered for one session of a port
_JOINS_WINDOW: Final = 1_024  # how far joins may overtake each other
TWO_HELLOS_S: Final = 0.04  # in which two hellos may be asked for, both at once: a handshake needs them
_EAGER_HELLOS: Final = 4  # after a change, so that a lost one causes no delay
UNREACHABLE: Final = (-1, -1)


@dataclass(slots=True)
class Stranger:
    """A node whose membership is not accepted here.

    Args:
        domain: label of the domain that its certificate names; empty where it cannot be read.
        heard_s: monotonic seconds of its last hello.
    """

    domain: str
    reason: DropReason
    heard_s: float


class Strangers:
    """The refused neighbours of one port, kept for a message to the operator.

    Nothing here is proven: a refused certificate may contain anything. So labels serve for reading only, and their
    number is bounded.
    """

    def __init__(self) -> None:
        self._by_membership: dict[bytes, Stranger] = {}

    def record(self, membership: bytes, reason: DropReason, now_s: float) -> None:
        """Remember that a hello with this certificate, DER, was refused."""
        known = self._by_membership.get(membership)
        if known is not None:
            known.reason, known.heard_s = reason, now_s
            return
        if len(self._by_membership) >= STRANGERS_MAX:
            del self._by_membership[min(self._by_membership, key=lambda each: self._by_membership[each].heard_s)]
        self._by_membership[membership] = Stranger(issuer_label(membership), reason, now_s)

    def since(self, begin_s: float) -> list[Stranger]:
        """Return those heard at ``begin_s`` or later."""
        return [each for each in self._by_membership.values() if each.heard_s >= begin_s]


@dataclass(slots=True, kw_only=True)
class HelloPort:
    """A port as the control plane sees it."""

    owner: Name  # the node whose port it is
    index: int
    mac: bytes
    own_mtu: int  # what our end accepts, in bytes after the Ethernet header
    cost: int  # COST_AUTO: measured for each neighbour
    nonce: bytes
    exchange_key: ExchangeKey
    admission: Admission
    is_up: bool = True
    sequence: int = 0
    keepalive_sequence: int = 0
    eager: int = _EAGER_HELLOS  # hellos until they become rare
    hello_at_s: float = 0.0
    answer_at_s: float = float("inf")  # of a hello to candidates, as far as ``credit_bytes`` allow
    credit_bytes: int = 0  # received from them, and not answered yet
    owes_answer: bool = False  # an answer waits for credit
    said_s: tuple[float, float] = (float("-inf"),) * 2  # of the last hello but one, and of the last
    neighbours: dict[Name, Neighbour] = field(default_factory=dict)
    ended: dict[tuple[Name, bytes], tuple[int, int]] = field(default_factory=dict)  # last numbers
    # joins that were accepted, by session of the far end
    joins: dict[bytes, ReplayWindow] = field(default_factory=dict)
    said_mtus: dict[Name, int] = field(default_factory=dict)  # what each neighbour's end accepts
    addresses: dict[bytes, None] = field(default_factory=dict)  # of neighbours, former ones too; the last proven last
    observed: dict[Name, Endpoint] = field(default_factory=dict)  # where this end of a tunnel sees its neighbours
    qualities: dict[Name, LinkQuality] = field(default_factory=dict)  # of links to neighbours, former ones too
    strangers: Strangers = field(default_factory=Strangers)  # nodes whose hellos were refused

    @property
    def echo(self) -> bytes:
        """Return how others refer to our present session."""
        return echo_of(self.nonce, self.owner)

    @property
    def mtu(self) -> int:
        """Return what our end and those of all neighbours that are up accept, in bytes after the Ethernet header."""
        up = [n.mtu for n in self.neighbours.values() if n.state is NeighbourState.UP]
        return min([self.own_mtu, *up])

    def link_key(self, neighbour: Neighbour) -> int:
        """Return the key of the link to a neighbour on this port."""
        return link_key(self.mac, neighbour.mac)

    @property
    def hello_mtu(self) -> int:
        """Return an MTU that every node heard so far accepts; a neighbour behind a narrow end must get our hellos."""
        return min([self.own_mtu, *self.said_mtus.values()])

    def last_of(self, name: Name, nonce: bytes) -> int:
        """Return the last sequence number received in a neighbour's session, or -1."""
        known = self.neighbours.get(name)
        if known is not None and nonce in (known.nonce, known.candidate):
            return known.sequence if known.nonce == nonce else known.candidate_sequence
        return self.ended.get((name, nonce), UNREACHABLE)[0]

    @property
    def is_idle(self) -> bool:
        """Return whether keepalives pass both ways with all neighbours; candidates do not count."""
        sessions = [each.keepalives for each in self.neighbours.values() if each.is_proven]
        return bool(sessions) and all(each is not None and each.is_alive and each.hears_us for each in sessions)

    def hurry(self, at_s: float) -> None:
        """Send a hello at ``at_s`` or before, and then often for a while: its content has changed."""
        self.hello_at_s, self.eager = min(self.hello_at_s, at_s), _EAGER_HELLOS

    def next_hello_s(self, now_s: float) -> float:
        """Return when a hello may leave that something asks for."""
        return max(now_s, self.said_s[0] + TWO_HELLOS_S)

    def schedule_hello(self, received_bytes: int, now_s: float) -> None:
        """Send a hello to candidates soon, with at most as many bytes as came from candidates."""
        self.credit_bytes = min(self.credit_bytes + received_bytes, _CREDIT_MAX_BYTES)
        self.answer_at_s = min(self.answer_at_s, self.next_hello_s(now_s))

    def note_address(self, mac: bytes) -> bool:
        """Note that a neighbour has this address; return whether that is news."""
        is_new = mac not in self.addresses
        self.addresses.pop(mac, None)
        self.addresses[mac] = None
        if len(self.addresses) > _ADDRESSES_MAX:
            del self.addresses[next(iter(self.addresses))]
        return is_new

    def cost_to(self, name: Name) -> int:
        """Return the cost of the link to a neighbour: the port's, or the damped one that was measured."""
        return self.quality_of(name).cost.advertised if self.cost == COST_AUTO else self.cost

    def quality_of(self, name: Name) -> LinkQuality:
        """Return the measurements of the link to a neighbour; a link that comes back keeps its own."""
        known = self.qualities.pop(name, None) or LinkQuality()
        self.qualities[name] = known
        if len(self.qualities) > _QUALITIES_MAX:
            del self.qualities[next(each for each in self.qualities if each not in self.neighbours)]
        return known

    def candidates(self) -> list[Neighbour]:
        """Return the nodes that were heard, and have not echoed our nonce."""
        return [each for each in self.neighbours.values() if not each.is_proven]

    def neighbour_at(self, mac: bytes, *, is_up: bool = False) -> Neighbour | None:
        """Return the neighbour with this address, or None; ``is_up``: no other one counts."""
        for each in self.neighbours.values():
            if each.mac == mac and (each.state is NeighbourState.UP or not is_up):
                return each
        return None

    def echoes(self) -> tuple[bytes, ...]:
        """Return the echoes that a hello carries: neighbours first, then candidates, the newest first."""
        proven = [each for each in self.neighbours.values() if each.is_proven]
        others = sorted(self.candidates(), key=lambda each: each.heard_s, reverse=True)
        restarts = [echo_of(each.candidate, each.name) for each in proven if each.candidate]
        return *(each.echo for each in proven), *(each.echo for each in others), *restarts

    def end(self, neighbour: Neighbour) -> None:
        """Remember the last number of a proven session; an unproven one cannot bring a neighbour up again."""
        if neighbour.is_proven:
            session = neighbour.name, neighbour.nonce  # another member could also send a nonce alone
            _, received = self.ended.pop(session, UNREACHABLE)
            if neighbour.keepalives is not None:
                received = neighbour.keepalives.received
            self.ended[session] = neighbour.sequence, received
            if len(self.ended) > _ENDED_MAX:
                del self.ended[next(iter(self.ended))]

    def note_ended(self, name: Name, nonce: bytes, received: int) -> None:
        """Note the last keepalive of a session that has ended, if it is remembered."""
        if (name, nonce) in self.ended:
            sequence, before = self.ended[name, nonce]
            self.ended[name, nonce] = sequence, max(before, received)

    def receive_join(self, join: Join | JoinRefresh | ReaderPace, neighbour: Neighbour) -> None:
        """Note a verified join, leave or refresh of a neighbour.

        Raises:
            StatementError: REPLAYED: it is of another session of either end, came before, or is below the replay
                window.
        """
        if (join.session, join.sender_session) != (self.echo, neighbour.nonce):
            raise StatementError(DropReason.REPLAYED, "a join of another session")
        window = self.joins.get(neighbour.nonce)
        if window is None:
            if len(self.joins) >= _ENDED_MAX:
                del self.joins[next(iter(self.joins))]
            window = self.joins[neighbour.nonce] = ReplayWindow(_JOINS_WINDOW)
        if window.is_finished(join.sequence):
            raise StatementError(DropReason.REPLAYED, "join")
        window.finish(join.sequence)
