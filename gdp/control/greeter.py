"""Finding neighbours, proving who they are, and noticing when they are gone.

Place: pure; every node that has a port greets: switches, RIBs, proxies.

A hello is signed by a member of a trusted domain and carries its certificate. It counts as two-way when it echoes the
nonce of our port's present session, and is newer than all that came of its own, so a recorded hello brings nobody up:
of sessions that ended, too, the last sequence number is remembered.

Hellos also say what each end takes: a link is as wide as its narrowest end. Where an end changes, both know at once.

Between neighbours that are up, keepalives (``keepalive.py``) take over from most hellos: a silent cut is noticed after
the negotiated detection time. Time in which this node itself was not called counts for nobody's silence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gdp.control.frames import ControlSplitter
from gdp.control.hello import DIGEST_BYTES, LIFE_BYTES, NO_KEEPALIVES, NONCE_BYTES, RTCERTS_MAX, Hello, Timing
from gdp.control.join import Join
from gdp.control.keepalive import KeepaliveSession, Slowness
from gdp.control.neighbour import TRANSITIONS, Neighbour, NeighbourEvent, NeighbourState
from gdp.control.rivals import Rivals
from gdp.control.settings import NodeSettings
from gdp.control.strangers import Strangers
from gdp.crypto.certificates import Membership, Role
from gdp.crypto.exchange import EXCHANGE_KEY_BYTES, ExchangeKey
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, StatementType
from gdp.effects import BROADCAST, Arrival, Instant, Transmit
from gdp.errors import DropReason, FrameError, StatementError
from gdp.frame.codec import Header
from gdp.frame.kinds import Kind
from gdp.limits import DEAD_S, HELLO_IDLE, HELLO_S, MTU_MIN_BYTES
from gdp.message.replay import ReplayWindow
from gdp.names import Name
from gdp.trust.domain import Policy
from gdp.trust.rtcert import RtCertCache

__all__ = ["Change", "Greeter", "LinkPort"]

NEIGHBOURS_PER_PORT: Final = 32
_UNHEARD: Final = (-1, -1)
_RTCERTS_REMEMBERED: Final = 256
_ENDED_MAX: Final = 1_024  # sessions of the far ends, remembered for one session of a port
_JOINS_WINDOW: Final = 1_024  # how far joins may overtake each other
_ANSWER_S: Final = 0.02  # a stranger's hello is answered at once, but not more often than this
_EAGER_HELLOS: Final = 4  # after a change, so that a lost one delays nobody
_HELLOS_MISSED: Final = 5  # idle hello intervals after which keepalives alone keep nobody up
_RECHECK_S: Final = 1.0  # a membership may be revoked or run out while keepalives come
_LATE_S: Final = 0.02  # called later than this, a node had no time of its own
_CLASH_S: Final = 3.0  # for so long another node must have our identity
_CLASH_PAUSE_S: Final = 10.0  # above the time between two idle hellos
_TOGETHER: Final = 0.125  # of an interval: keepalives due within it leave at once

# A neighbour after the change, and its state before; the same state where only the link to it changed, MTU or cost.
Change = tuple[Neighbour, NeighbourState]


@dataclass(slots=True)
class LinkPort:
    """A port as the control plane sees it."""

    index: int
    mac: bytes
    own_mtu: int  # what our end takes, in bytes after the Ethernet header
    cost: int
    nonce: bytes
    exchange_key: ExchangeKey
    is_up: bool = True
    sequence: int = 0
    keepalive_sequence: int = 0
    eager: int = _EAGER_HELLOS  # hellos until they become rare
    hello_at_s: float = 0.0
    said_s: float = float("-inf")
    neighbours: dict[Name, Neighbour] = field(default_factory=dict)
    ended: dict[bytes, tuple[int, int]] = field(default_factory=dict)  # nonce to last hello and keepalive
    joins: dict[Name, ReplayWindow] = field(default_factory=dict)  # which joins were taken in this session
    said_mtus: dict[Name, int] = field(default_factory=dict)  # what each neighbour's end takes
    strangers: Strangers = field(default_factory=Strangers)  # whose hellos were refused

    @property
    def mtu(self) -> int:
        """Return what our end and those of all neighbours that are up take, in bytes after the Ethernet header."""
        up = [n.mtu for n in self.neighbours.values() if n.state is NeighbourState.UP]
        return min([self.own_mtu, *up])

    @property
    def hello_mtu(self) -> int:
        """Return what everybody takes who was heard at all: a neighbour behind a narrow end must hear us to be up."""
        return min([self.own_mtu, *self.said_mtus.values()])

    def last_of(self, name: Name, nonce: bytes) -> int:
        """Return the last sequence number that came of a neighbour's session, or -1."""
        known = self.neighbours.get(name)
        return known.sequence if known is not None and known.nonce == nonce else self.ended.get(nonce, _UNHEARD)[0]

    @property
    def is_idle(self) -> bool:
        """Return whether all neighbours are up and hear us, and we them, by keepalives."""
        sessions = [each.keepalives for each in self.neighbours.values()]
        return bool(sessions) and all(each is not None and each.is_heard and each.hears_us for each in sessions)

    def hurry(self, at_s: float) -> None:
        """Say hello at ``at_s`` or before, and then often for a while: what it says has changed."""
        self.hello_at_s, self.eager = min(self.hello_at_s, at_s), _EAGER_HELLOS

    def end(self, neighbour: Neighbour) -> None:
        """Remember how far a session came."""
        if neighbour.nonce:
            _, received = self.ended.pop(neighbour.nonce, _UNHEARD)
            if neighbour.keepalives is not None:
                received = neighbour.keepalives.received
            self.ended[neighbour.nonce] = neighbour.sequence, received
            if len(self.ended) > _ENDED_MAX:
                del self.ended[next(iter(self.ended))]

    def take_join(self, join: Join, name: Name) -> None:
        """Note a verified join or leave of a neighbour.

        Raises:
            StatementError: REPLAYED: it is of another session of this port, came before, or is too old to tell.
        """
        if join.session != self.nonce:
            raise StatementError(DropReason.REPLAYED, "a join of another session")
        window = self.joins.get(name)
        if window is None:
            if len(self.joins) >= _ENDED_MAX:
                del self.joins[next(iter(self.joins))]
            window = self.joins[name] = ReplayWindow(_JOINS_WINDOW)
        if window.is_finished(join.sequence):
            raise StatementError(DropReason.REPLAYED, "join")
        window.finish(join.sequence)


class Greeter:
    """Greets on every port.

    Args:
        random_bytes: source of nonces and of session keys.
        timing: what this node wants of keepalives, where ``set_timing`` says nothing else of a port.
        life: mark of this node's life, ``LIFE_BYTES``.
        digest_for: what to say of our link state to the far end of a port.
        life_elsewhere: the mark of a node with a name that is known to be alive, but at none of our ports; or None.
        rtcert_for: of a RIB, its RtCert for a switch; None of any other node.

    Attributes:
        rivals: nodes that share an identity with another one, at our ports.
        clashes: how often we heard of another node with our own identity.
        clash_told_by: the neighbour that said so last.
    """

    def __init__(
        self,
        identity: Identity,
        policy: Policy,
        splitter: ControlSplitter,
        random_bytes: Callable[[int], bytes],
        *,
        hello_s: float = HELLO_S,
        dead_s: float = DEAD_S,
        timing: Timing = NO_KEEPALIVES,
        incarnation: int = 0,
        life: bytes = bytes(LIFE_BYTES),
        digest_for: Callable[[LinkPort], bytes] = lambda _: bytes(DIGEST_BYTES),
        life_elsewhere: Callable[[Name], bytes | None] = lambda _: None,
        rtcert_for: Callable[[Name], bytes] | None = None,
    ) -> None:
        self._identity = identity
        self._policy = policy
        self._splitter = splitter
        self._random_bytes = random_bytes
        self._hello_s = hello_s
        self._dead_s = dead_s
        self._timing = timing
        self._timings: dict[int, Timing] = {}
        self._incarnation = incarnation
        self._due_s = float("inf")  # when the next call was asked for
        self._next_s: float | None = None  # no timer is due before; None: to be looked up
        self._lateness_s = 0.0  # how long, in all, this node was called later than it had asked to be
        self._slowness = Slowness()
        self._digest_for = digest_for
        self._life = life
        self._life_elsewhere = life_elsewhere
        self._rtcert_for = rtcert_for
        self._rtcerts = RtCertCache(_RTCERTS_REMEMBERED)
        self.rivals = Rivals()
        self.clashes = 0
        self.clash_told_by: Name | None = None
        self._clash_since_s = self._clash_s = float("-inf")
        self.ports: dict[int, LinkPort] = {}

    @classmethod
    def of_node(
        cls,
        identity: Identity,
        policy: Policy,
        splitter: ControlSplitter,
        settings: NodeSettings,
        *,
        digest_for: Callable[[LinkPort], bytes] = lambda _: bytes(DIGEST_BYTES),
        life_elsewhere: Callable[[Name], bytes | None] = lambda _: None,
        rtcert_for: Callable[[Name], bytes] | None = None,
    ) -> Greeter:
        """Return the greeter of a node with these settings."""
        return cls(
            identity,
            policy,
            splitter,
            settings.random_bytes,
            hello_s=settings.hello_s,
            dead_s=settings.dead_s,
            timing=settings.timing,
            incarnation=settings.incarnation,
            life=settings.life,
            digest_for=digest_for,
            life_elsewhere=life_elsewhere,
            rtcert_for=rtcert_for,
        )

    def set_timing(self, index: int, timing: Timing) -> None:
        """Want other keepalives on one port, from its next session on."""
        self._timings[index] = timing
        self._next_s = None

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now_s: float) -> list[Change]:
        """Begin to greet on a port, or learn that the MTU or cost of one that is up has changed.

        Returns the neighbours to which the link has changed, and those that another address of ours takes away.
        """
        self._next_s = None
        port, own_mtu = self.ports.get(index), max(mtu, MTU_MIN_BYTES)
        if port is None or not port.is_up or port.mac != mac:
            lost = [] if port is None else self._lose(port, list(port.neighbours.values()), NeighbourEvent.LINK_LOST)
            nonce, key = self._session()
            self.ports[index] = LinkPort(index, mac, own_mtu, cost, nonce, key, hello_at_s=now_s)
            return lost
        if (port.own_mtu, port.cost) == (own_mtu, cost):
            return []
        port.own_mtu, port.cost = own_mtu, cost
        port.hurry(now_s)  # the other ends must know
        for neighbour in port.neighbours.values():
            neighbour.mtu = min(port.said_mtus[neighbour.name], own_mtu)
        return [(each, each.state) for each in port.neighbours.values() if each.state is NeighbourState.UP]

    def neighbour(self, port: int, name: Name) -> Neighbour | None:
        """Return the neighbour of that name that is up on a port, or None."""
        on = self.ports.get(port)
        found = on.neighbours.get(name) if on is not None else None
        return found if found is not None and found.state is NeighbourState.UP else None

    def all_up(self) -> list[Neighbour]:
        """Return every neighbour that is up."""
        return [n for port in self.ports.values() for n in port.neighbours.values() if n.state is NeighbourState.UP]

    def receive(self, arrival: Arrival, statement: Statement, now: Instant) -> Change | None:
        """Take a hello; return what it changed.

        Raises:
            StatementError: it does not hold; nothing has changed.
        """
        hello = Hello.from_fields(statement.expect(StatementType.HELLO))
        self._next_s = None
        port = self.ports.get(arrival.port)
        if port is None or not port.is_up:
            return None
        if statement.signer == self._identity.name:
            raise StatementError(DropReason.NOT_FOR_US, "our own hello came back")
        try:
            member = self._policy.verify_membership(hello.membership, now.unix_s)
        except StatementError as error:
            port.strangers.note(hello.membership, error.reason, now.mono_s)
            raise
        if member.name != statement.signer:
            raise StatementError(DropReason.BAD_CERTIFICATE, "a hello under another's certificate")
        known = port.neighbours.get(member.name)
        if hello.sequence <= port.last_of(member.name, hello.nonce):
            raise StatementError(DropReason.REPLAYED, "hello")
        statement.verify(member.key)
        self._refuse_rival(port, hello, member.name, arrival.mac, now.mono_s)
        self.rivals.take(member.name, hello.life)
        if known is None:
            if len(port.neighbours) >= NEIGHBOURS_PER_PORT:
                raise StatementError(DropReason.QUOTA, "neighbours on one port")
            known = port.neighbours[member.name] = Neighbour(
                member.name, member.role, member.domain, member.key, port.index, arrival.mac, 0, b"", 0, b"", 0.0
            )
        is_two_way = port.nonce in hello.heard
        is_new_session = known.nonce != hello.nonce
        if not is_two_way or is_new_session:
            port.hurry(max(now.mono_s, port.said_s + _ANSWER_S))
        if is_new_session and not is_two_way and known.state is NeighbourState.UP:
            known.candidate = hello.nonce  # a restart, or an old hello played back: only an echo of our nonce will tell
            return None
        if is_new_session or not is_two_way:
            port.end(known)
            known.keepalives = None
        said_mtu = port.said_mtus[known.name] = max(hello.mtu, MTU_MIN_BYTES)
        mtu = min(said_mtu, port.own_mtu)
        is_resized = known.mtu != mtu
        known.mac, known.mtu, known.nonce, known.candidate = arrival.mac, mtu, hello.nonce, b""
        known.sequence, known.digest, known.greeted_s = hello.sequence, hello.digest, now.mono_s
        known.member, known.checked_s, known.life = member, now.mono_s, hello.life
        had_proof, known.proof = known.proof is not None, self._proof_of_place(hello, member)
        self._note_clash(port, known, hello, now.mono_s)
        self._alive(known, now.mono_s)
        if is_two_way and known.keepalives is None:
            self._begin_keepalives(port, known, hello, now.mono_s)
        change = self._step(known, NeighbourEvent.TWO_WAY if is_two_way else NeighbourEvent.ONE_WAY)
        if change is None and is_new_session and is_two_way:
            return known, NeighbourState.GONE  # it restarted, and has forgotten what we told it
        is_placed = (known.proof is not None) is not had_proof
        if change is None and (is_resized or is_placed) and known.state is NeighbourState.UP:
            return known, known.state
        return change

    def _proof_of_place(self, hello: Hello, member: Membership) -> tuple[bytes, bytes] | None:
        """Return what proves to others that a RIB is attached to this switch, or None.

        Raises:
            StatementError: its hello carries what it did not sign.
        """
        if member.role is not Role.RIB:
            return None
        for wire in hello.rtcerts:
            rtcert = self._rtcerts.verified(wire, member.name, member.key)
            if rtcert.switch == self._identity.name:
                return hello.membership, wire
        return None

    def _refuse_rival(self, port: LinkPort, hello: Hello, name: Name, mac: bytes, now_s: float) -> None:
        """Take a hello's word only if no older node with its identity is alive; a younger one is let go.

        Raises:
            StatementError: IN_USE.
        """
        others = [
            other
            for each in self.ports.values()
            if (other := each.neighbours.get(name)) is not None
            and other.life != hello.life
            and now_s < self._gone_at_s(other)
        ]
        if any((other.port, other.mac) == (port.index, mac) for other in others):
            return  # it was restarted there
        elsewhere = self._life_elsewhere(name)
        is_outlived_here = any(other.life < hello.life for other in others)
        for other in others:
            if is_outlived_here:
                self._tell_rival(other.port, other.nonce, name, now_s)
            else:
                self.let_go(other, now_s)
        if not is_outlived_here and (elsewhere is None or hello.life <= elsewhere):
            return
        self.rivals.refuse(name, hello.life, now_s)
        self._tell_rival(port.index, hello.nonce, name, now_s)
        raise StatementError(DropReason.IN_USE, "an older node with this identity is alive")

    def recheck(self, fingerprint: bytes, now: Instant) -> None:
        """Have ``expire`` let neighbours go whose membership, of this fingerprint, was revoked."""
        for port in self.ports.values():
            for neighbour in port.neighbours.values():
                member = neighbour.member
                if member is None or member.fingerprint != fingerprint:
                    continue
                try:
                    self._policy.check_member(member, now.unix_s)
                except StatementError:
                    self._next_s = None
                    neighbour.heard_s = float("-inf")

    def let_go(self, neighbour: Neighbour, now_s: float) -> None:
        """Have ``expire`` let a neighbour go, for an older node with its identity is alive."""
        self._next_s = None
        self.rivals.refuse(neighbour.name, neighbour.life, now_s)
        self._tell_rival(neighbour.port, neighbour.nonce, neighbour.name, now_s)
        neighbour.heard_s = float("-inf")

    def tell_rivals(self, name: Name, now_s: float) -> None:
        """Tell a neighbour, where it is one, that another node has its identity."""
        for port in self.ports.values():
            held = port.neighbours.get(name)
            if held is not None:
                self._tell_rival(port.index, held.nonce, name, now_s)

    def _tell_rival(self, port: int, nonce: bytes, name: Name, now_s: float) -> None:
        """See that hellos tell a session of its rival, soon if that is news to it."""
        if self.rivals.tell(port, nonce, name, now_s):
            self._next_s = None
            self.ports[port].hurry(now_s)

    def note_clash(self, told_by: Name, now_s: float, *, is_proven: bool = False) -> None:
        """Note that another node has our own identity.

        Args:
            is_proven: it counts at once; else when it lasts, for an earlier life of ours may linger.
        """
        if now_s > self._clash_s + _CLASH_PAUSE_S:
            self._clash_since_s = now_s
        self._clash_s = now_s
        if is_proven or now_s >= self._clash_since_s + _CLASH_S:
            self.clashes += 1
            self.clash_told_by = told_by

    def _note_clash(self, port: LinkPort, neighbour: Neighbour, hello: Hello, now_s: float) -> None:
        """Note what a neighbour's hello says of our identity."""
        neighbour.refuses_us = port.nonce in hello.rivals and port.nonce not in hello.heard
        if port.nonce in hello.rivals:
            self.note_clash(neighbour.name, now_s)

    def receive_keepalive(self, arrival: Arrival, header: Header, now: Instant) -> Neighbour:
        """Take a keepalive; return the neighbour that it is of.

        Raises:
            FrameError: UNKNOWN_SENDER, REPLAYED, BAD_TAG or TRUNCATED; nothing has changed.
            StatementError: the neighbour's membership holds no longer.
        """
        port = self.ports.get(arrival.port)
        known = port.neighbours.get(Name(header.source)) if port is not None else None
        if known is None or known.keepalives is None:
            raise FrameError(DropReason.UNKNOWN_SENDER, "a keepalive")
        if known.member is not None and now.mono_s >= known.checked_s + _RECHECK_S:
            self._policy.check_member(known.member, now.unix_s)
            known.checked_s = now.mono_s
        known.digest = known.keepalives.open(header, arrival.frame, now.mono_s)
        if known.keepalives.is_final_due:
            self._next_s = None  # anything else only puts timers off
        self._alive(known, now.mono_s - arrival.waited_s)
        return known

    def port_changed(self, index: int, up: bool, now_s: float) -> list[Change]:
        """Learn that a link came or went; return the neighbours that this took away."""
        self._next_s = None
        port = self.ports.get(index)
        if port is None or port.is_up == up:
            return []
        port.is_up = up
        if up:
            port.nonce, port.exchange_key = self._session()
            port.ended.clear()
            port.joins.clear()
            port.hurry(now_s)
            return []
        return self._lose(port, list(port.neighbours.values()), NeighbourEvent.LINK_LOST)

    def expire(self, now_s: float) -> list[Change]:
        """Let silent neighbours go; return them. What waits at the sockets must have been taken before."""
        if float("-inf") < self._due_s < now_s - _LATE_S:  # who is let go is due at once: nobody is late
            self._lateness_s += now_s - self._due_s
            self._slowness.late(now_s - self._due_s, now_s)
        self._due_s, self._next_s = float("inf"), None
        changes: list[Change] = []
        for port in self.ports.values():
            silent = [n for n in port.neighbours.values() if now_s >= self._gone_at_s(n)]
            if silent:
                port.hurry(now_s)  # who still hears us hears at once that we do not hear it
                changes += self._lose(port, silent, NeighbourEvent.SILENCE)
        return changes

    def take(self, now_s: float) -> list[Transmit]:
        """Return the hellos and keepalives that are due."""
        self._next_s = None
        out: list[Transmit] = []
        for port in self.ports.values():
            if not port.is_up:
                continue
            if port.hello_at_s <= now_s:
                out.append(Transmit(port.index, BROADCAST, self._hello(port, now_s)))
            for neighbour in port.neighbours.values():
                session = neighbour.keepalives
                if session is None:
                    continue
                is_suspect = session.suspect_at_s(neighbour.heard_s) <= now_s
                if is_suspect or session.send_at_s <= now_s + session.out_interval_s * _TOGETHER:
                    port.keepalive_sequence += 1
                    timing = self._timings.get(port.index, self._timing)
                    frame = session.seal(
                        (self._identity.name, self._incarnation),
                        port.keepalive_sequence,
                        self._slowness.multiplier(timing, self._dead_s, now_s),
                        self._digest_for(port),
                        now_s,
                        poll=is_suspect,
                    )
                    out.append(Transmit(port.index, neighbour.mac, [frame]))
        return out

    def next_timeout(self) -> float | None:
        """Return a monotonic second that is no later than the next hello, keepalive or silence of a neighbour."""
        if self._next_s is None:
            self._next_s = self._look_ahead()
        self._due_s = self._next_s
        return None if self._due_s == float("inf") else self._due_s

    def _look_ahead(self) -> float:
        due_s = float("inf")
        for port in self.ports.values():
            if port.is_up and port.hello_at_s < due_s:
                due_s = port.hello_at_s
            for neighbour in port.neighbours.values():
                session, at_s = neighbour.keepalives, self._gone_at_s(neighbour)
                if session is not None and port.is_up:
                    at_s = min(at_s, session.send_at_s, session.suspect_at_s(neighbour.heard_s))
                due_s = min(due_s, at_s)
        return due_s

    def _gone_at_s(self, neighbour: Neighbour) -> float:
        """Return when a neighbour is gone if nothing comes of it; the node's own lateness is no silence of theirs."""
        late_s = self._lateness_s - neighbour.lateness_s
        session = neighbour.keepalives
        if session is None or not session.is_heard:
            return neighbour.heard_s + self._dead_s + late_s
        hellos_end_s = neighbour.greeted_s + _HELLOS_MISSED * HELLO_IDLE * self._hello_s
        return min(neighbour.heard_s + session.detect_s, hellos_end_s) + late_s

    def _alive(self, neighbour: Neighbour, heard_s: float) -> None:
        neighbour.heard_s, neighbour.lateness_s = heard_s, self._lateness_s

    def _session(self) -> tuple[bytes, ExchangeKey]:
        """Return nonce and key of a new session of a port."""
        return self._random_bytes(NONCE_BYTES), ExchangeKey.from_random(self._random_bytes(EXCHANGE_KEY_BYTES))

    def _begin_keepalives(self, port: LinkPort, neighbour: Neighbour, hello: Hello, now_s: float) -> None:
        timing = self._timings.get(port.index, self._timing)
        ends = port.nonce + self._identity.name, neighbour.nonce + neighbour.name
        _, received = port.ended.get(neighbour.nonce, _UNHEARD)
        neighbour.keepalives = KeepaliveSession.begin(
            port.exchange_key, hello.exchange_key, ends, (timing, hello.timing), received, now_s
        )

    def _hello(self, port: LinkPort, now_s: float) -> list[bytes]:
        port.sequence += 1
        port.said_s = now_s
        port.eager = max(port.eager - 1, 0)
        port.hello_at_s = now_s + self._hello_s * (HELLO_IDLE if port.is_idle and not port.eager else 1)
        heard = tuple(n for each in port.neighbours.values() for n in (each.nonce, each.candidate) if n)
        identity, timing = self._identity, self._timings.get(port.index, self._timing)
        hello = Hello(
            port.nonce, port.sequence, heard, port.own_mtu, self._digest_for(port), identity.membership,
            timing, port.exchange_key.public, self._life, self.rivals.on(port.index, now_s), self._rtcerts_on(port),
        )  # fmt: skip
        return self._splitter.split(Kind.HELLO, hello.to_wire(identity.name, identity.key), port.hello_mtu)

    def _rtcerts_on(self, port: LinkPort) -> tuple[bytes, ...]:
        """Return a RIB's RtCerts for the switches that it hears on a port."""
        if self._rtcert_for is None:
            return ()
        switches = sorted(each.name for each in port.neighbours.values() if each.role is Role.SWITCH)
        return tuple(self._rtcert_for(name) for name in switches[:RTCERTS_MAX])

    def _lose(self, port: LinkPort, lost: list[Neighbour], event: NeighbourEvent) -> list[Change]:
        for neighbour in lost:
            del port.neighbours[neighbour.name], port.said_mtus[neighbour.name]
            port.end(neighbour)
        return [change for neighbour in lost if (change := self._step(neighbour, event)) is not None]

    @staticmethod
    def _step(neighbour: Neighbour, event: NeighbourEvent) -> Change | None:
        before = neighbour.state
        neighbour.state = TRANSITIONS[before, event]
        return None if neighbour.state is before else (neighbour, before)
