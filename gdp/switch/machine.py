"""A switch's control plane: what it hears from neighbours, asks of its RIB, and writes into the forwarding table.

Place: pure; a shell or a simulated network feeds it the frames that its data plane hands up, and the time.

The walk of a frame that was handed up::

    kind >= 0x80  -> joined to a statement -> hello | link state | claim, withdrawal | join, leave
    addressed to us -> a RIB's answer, or an echo
    anything else -> no entry yet: Unicast finds the way, or parks the frame and asks
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Final

from gdp.control.boundary import ErrorBoundary
from gdp.control.channel import Channels, Opened
from gdp.control.frames import ControlJoiner, ControlSplitter
from gdp.control.greeter import Change, Greeter, LinkPort
from gdp.control.join import Join
from gdp.control.neighbour import Neighbour, NeighbourState
from gdp.control.query import Query
from gdp.control.revocation_sync import RevocationSync
from gdp.control.settings import NodeSettings
from gdp.control.waiting import Wait, WaitReason, port_waits, stranger_waits
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.effects import Arrival, Instant, Transmit
from gdp.errors import DropReason, FrameError, RemoteError, StatementError
from gdp.frame.codec import HEADER_BYTES, Header, decode, encode
from gdp.frame.kinds import CONTROL_FROM, Kind
from gdp.limits import CLAIMS_BURST, CLAIMS_PER_S, HOPS_MAX, JOINS_BURST, JOINS_PER_S
from gdp.message.token_bucket import Paces
from gdp.names import Name
from gdp.switch.attached import Attached
from gdp.switch.claims import Claims
from gdp.switch.evidence import Evidence
from gdp.switch.flooding import Flooding
from gdp.switch.held import Held
from gdp.switch.inquirer import Inquirer
from gdp.switch.locations import Locations
from gdp.switch.name_resolver import NameResolver
from gdp.switch.outbox import Outbox
from gdp.switch.planter import Planter
from gdp.switch.presence import PresenceAnswers
from gdp.switch.relocation import Relocations
from gdp.switch.revoker import Revoker
from gdp.switch.spf_delay import SpfDelay
from gdp.switch.table import Table
from gdp.switch.unicast import Unicast
from gdp.trust.domain import Policy
from gdp.trust.right import HEARS, Right
from gdp.trust.verifier import ClaimVerifier

__all__ = ["Switch"]

_PROTECT_S: Final = 0.1  # from new paths to their alternates, which nobody waits for
_RIVALS_S: Final = 1.0  # between two looks at identities that are refused elsewhere
_CONTROL = frozenset(kind.value for kind in Kind if kind >= CONTROL_FROM)


class Switch:
    """The machine of one switch.

    Args:
        table: the forwarding table that the data plane reads.
    """

    def __init__(self, identity: Identity, policy: Policy, table: Table, settings: NodeSettings) -> None:
        self._identity = identity
        self._policy = policy
        self.table = table
        self._splitter = ControlSplitter(identity.name, settings.incarnation)
        self._joiner = ControlJoiner()
        self.greeter = Greeter.of_node(
            identity, policy, self._splitter, settings,
            digest_for=self._digest_for, life_elsewhere=self._life_elsewhere,
        )  # fmt: skip
        self._outbox = Outbox(self.greeter, self._splitter)
        self._flooding = Flooding(
            identity=identity, policy=policy, greeter=self.greeter, send=self._send_link_state,
            first_sequence=settings.first_sequence, life=settings.life,
        )  # fmt: skip
        self._paths = self._flooding.paths
        self._verifier = ClaimVerifier(policy)
        self._incarnation = settings.incarnation
        self.attached = Attached()
        self.resolver = NameResolver(identity.name, settings.lease_s)
        self.planter = Planter(
            identity=identity, policy=policy, table=table, paths=self._paths, attached=self.attached,
            outbox=self._outbox, first_sequence=settings.first_sequence,
        )  # fmt: skip
        self.unicast = Unicast(
            me=identity.name, own_domain=policy.own, transit=policy.transit, table=table, paths=self._paths,
            resolver=self.resolver, attached=self.attached, outbox=self._outbox,
        )  # fmt: skip
        self._evidence = Evidence(policy, self._verifier)
        self._held = Held(self.attached, self.resolver.cache, self.planter)
        self._sync = RevocationSync(
            identity, policy.revoked, self.greeter,
            lambda neighbour, wire: self._outbox.say(neighbour, Kind.REVOKED, wire), settings.first_sequence,
        )  # fmt: skip
        self._revoker = Revoker(
            verifier=self._verifier, greeter=self.greeter, attached=self.attached, planter=self.planter,
            unicast=self.unicast, resolver=self.resolver, evidence=self._evidence, held=self._held, sync=self._sync,
            outbox=self._outbox,
        )  # fmt: skip
        self.relocations = Relocations(identity, policy, self.planter, self.unicast, self._outbox)
        self._seen_version = -1
        self._spf_delay = SpfDelay()
        self._protect_at_s: float | None = None  # when alternates are computed
        self._followed_s = self._rivals_sought_s = float("-inf")
        self._presence = PresenceAnswers(identity, self.greeter, self.attached, self.unicast, self._outbox)
        self._channels = Channels(identity, policy, settings.random_bytes, accepts=False)
        self._locations = Locations(
            identity=identity, policy=policy, attached=self.attached, resolver=self.resolver, planter=self.planter,
            unicast=self.unicast, relocations=self.relocations, held=self._held, outbox=self._outbox,
        )  # fmt: skip
        self.inquirer = Inquirer(
            identity=identity, policy=policy, paths=self._paths, attached=self.attached, resolver=self.resolver,
            planter=self.planter, unicast=self.unicast, relocations=self.relocations, evidence=self._evidence,
            locations=self._locations, outbox=self._outbox, presence=self._presence, channels=self._channels,
        )  # fmt: skip
        self._claims = Claims(
            identity=identity, verifier=self._verifier, attached=self.attached, resolver=self.resolver,
            planter=self.planter, unicast=self.unicast, inquirer=self.inquirer, locations=self._locations,
            relocations=self.relocations, held=self._held, outbox=self._outbox,
        )  # fmt: skip
        self.boundary = ErrorBoundary()
        self._join_paces = Paces(JOINS_PER_S, JOINS_BURST)
        self._claim_paces = Paces(CLAIMS_PER_S, CLAIMS_BURST)
        self._drops: Counter[DropReason] = Counter()
        self._rest_due_s: float | None = None  # when something other than the greeter is due; None: to be looked up

    @property
    def name(self) -> Name:
        """Return the switch's name."""
        return self._identity.name

    @property
    def rib(self) -> Name | None:
        """Return the RIB that is asked, or None while none is known."""
        return self.inquirer.rib

    @property
    def severed(self) -> frozenset[Name]:
        """Return the switches of the domain that leaves alone join to this one, so that no way leads to them."""
        return self._paths.severed()

    @property
    def is_displaced(self) -> bool:
        """Return whether an older switch with this identity is alive, so that this one has to end."""
        return self._flooding.is_displaced

    @property
    def link_states(self) -> int:
        """Return how many link states are known."""
        return len(self._flooding.link_states)

    def waits(self, attachments: Collection[int], now_s: float) -> list[Wait]:
        """Return what this switch waits for before it can serve; empty when nothing is missing.

        Args:
            attachments: ports made for nodes of the same host, which may start at any time: an empty one is no reason.
        """
        waits = list(stranger_waits(self.greeter, now_s))
        refusing = {wait.port for wait in waits}
        for port in self.greeter.ports.values():
            if port.index not in attachments:
                found = port_waits(port, tuple(Role))
                waits += (each for each in found if port.index not in refusing or each.reason is WaitReason.LINK_DOWN)
        if severed := self.severed:
            waits.append(Wait(WaitReason.THROUGH_LEAF, name=min(severed)))
        if self.rib is None:
            waits.append(Wait(WaitReason.NO_RIB))
        return waits

    def drops(self) -> Mapping[DropReason, int]:
        """Return what the control plane dropped, by reason."""
        own = self._drops + self._joiner.drops + self.greeter.drops + self._channels.drops
        return own + self._flooding.drops + self.resolver.drops + self.planter.drops + self.unicast.drops

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Instant) -> None:
        """Begin to use a port, or learn that the MTU or cost of one that is up has changed."""
        self._rest_due_s = None
        self._flooding.look_at_clock(now)
        changes = self.greeter.add_port(index, mac, mtu, cost, now.mono_s)
        for change in changes:
            self._neighbour_changed(change, now.mono_s)
        if changes:
            self._follow_links(now.mono_s)

    def port_changed(self, port: int, up: bool, now: Instant) -> None:
        """Learn that a port's link came or went."""
        self._rest_due_s = None
        self._flooding.look_at_clock(now)
        for change in self.greeter.port_changed(port, up, now.mono_s):
            self._neighbour_changed(change, now.mono_s)
        self._follow_links(now.mono_s)  # at once: these frames would be lost

    def receive(self, arrivals: Sequence[Arrival], now: Instant) -> None:
        """Take frames that the data plane handed up."""
        has_others = False
        self._flooding.look_at_clock(now)
        for arrival in arrivals:
            try:
                header = decode(arrival.frame)
                if header.kind == Kind.KEEPALIVE:
                    self._take_keepalive(arrival, header, now)
                else:
                    has_others = True
                    self._take(arrival, header, now)
            except RemoteError as error:
                self._drops[error.reason] += 1
            except Exception as error:  # one frame must not end the switch
                self.boundary.note(error)
                self._drops[DropReason.INTERNAL] += 1
        if has_others:
            self._rest_due_s = None
            self._presence.answer(now.mono_s)
            self._flooding.tell_of_rivals(now.mono_s)
            self._plan_follow(now.mono_s)

    def timeout(self, now: Instant) -> None:
        """Do what is due."""
        now_s = now.mono_s
        self._flooding.look_at_clock(now)
        lost = self.greeter.expire(now_s)
        for change in lost:
            self._neighbour_changed(change, now_s)
        for hello in self.greeter.take(now_s):
            self._outbox.put(hello)
        if not lost and self._rest_due_s is not None and now_s < self._rest_due_s:
            return  # keepalives are most of what is due
        self._rest_due_s = None
        self._flooding.timeout(now_s)
        if lost or (self._spf_delay.due_s is not None and self._spf_delay.due_s <= now_s):
            self._follow_links(now_s)
        else:
            self._plan_follow(now_s)
        if self._protect_at_s is not None and self._protect_at_s <= now_s:
            self._protect_at_s = None
            self._paths.has_alternates = True
            self.unicast.refresh(now_s)
        if self.unicast.is_refreshing:
            self.unicast.refresh_more(now_s)
        if now_s >= self._rivals_sought_s + _RIVALS_S:
            self._look_for_rivals(now_s)
        self._joiner.expire(now_s)
        self._locations.expire(now_s)
        for key in self.table.expire(now_s):
            self.unicast.expired(key)
        for attachment in self.attached.expire(now_s):
            self.unicast.forget(attachment.claim.name)
        for topic in self.planter.timeout(now_s):
            self.resolver.unwatch(topic)
        self.relocations.timeout(now_s)
        self.inquirer.ask(now_s)
        self._sync.timeout(now_s)
        self._tell_rib_of_revocations(now_s)
        self._presence.answer(now_s)

    def next_timeout(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        if self._rest_due_s is None:
            self._rest_due_s = self._next_of_rest()
        greeter_s = self.greeter.next_timeout()
        return self._rest_due_s if greeter_s is None else min(greeter_s, self._rest_due_s)

    def _next_of_rest(self) -> float:
        """Return the monotonic second of the next timer that is not the greeter's."""
        times = [
            self._spf_delay.due_s,
            self._protect_at_s,
            self._flooding.next_timeout(),
            self.table.next_expiry(),
            self.planter.next_timeout(),
            self.resolver.next_expiry(),
            self.relocations.next_timeout(),
            self.inquirer.next_timeout(),
            self._sync.next_timeout(),
        ]
        if self.inquirer.rib is not None:
            times.append(self._revoker.next_due_for_rib())
        if self.unicast.is_refreshing:
            times.append(self._followed_s)  # past: at once
        if self._paths.refused_elsewhere():
            times.append(self._rivals_sought_s + _RIVALS_S)
        if self.inquirer.rib is None:
            times.append(self.attached.next_expiry())
        return min(time for time in times if time is not None)

    def take_neighbours(self) -> Mapping[int, frozenset[bytes]]:
        """Return, once, the addresses of neighbours, former ones too, at each port where they have changed."""
        return self.greeter.take_addresses()

    def take(self) -> list[Transmit]:
        """Return, once, what is to be sent: nothing from a switch whose identity an older one has."""
        return [] if self.is_displaced else self._outbox.take()

    def _unwatch(self, orphaned: Iterable[Name]) -> None:
        for topic in orphaned:
            self.resolver.unwatch(topic)

    def _take_revoked(self, neighbour: Neighbour, statement: Statement, now: Instant) -> None:
        """Take part in the comparison of revocations with a neighbour."""
        if statement.type is StatementType.REVOKE:
            self._unwatch(self._revoker.take_lacking(statement, neighbour, now))
        else:
            self._sync.receive(neighbour, statement, now)

    def _tell_rib_of_revocations(self, now_s: float) -> None:
        """Pass on to the RIB what the operator handed in."""
        if self.inquirer.rib is not None:
            for wire in self._revoker.due_for_rib(self.inquirer.rib, now_s):
                self.inquirer.relay(wire, now_s)

    def _digest_for(self, port: LinkPort) -> bytes:
        return self._flooding.digest_for(port)

    def revoke(self, wire: bytes, now: Instant) -> None:
        """Take a revocation from this node's operator, and spread it.

        Raises:
            StatementError: it does not hold.
        """
        self._rest_due_s = None
        self._unwatch(self._revoker.hand_in(parse(wire), now))
        self._tell_rib_of_revocations(now.mono_s)

    # -- frames

    def _take_keepalive(self, arrival: Arrival, header: Header, now: Instant) -> None:
        neighbour = self.greeter.receive_keepalive(arrival, header, now)
        if neighbour.role.is_switch:
            self._flooding.compare(neighbour, now.mono_s)

    def _take(self, arrival: Arrival, header: Header, now: Instant) -> None:
        if header.kind >= CONTROL_FROM:
            if header.kind not in _CONTROL:
                raise FrameError(DropReason.UNKNOWN_KIND, str(header.kind))
            if header.kind == Kind.COOKIE:
                self.greeter.receive_cookie(arrival, header)
                return
            if header.kind == Kind.HELLO:
                wire = self.greeter.join(arrival, header, now.mono_s)
            else:
                self._sender(arrival)  # for strangers no state is kept
                wire = self._joiner.add(header, arrival.frame, now.mono_s, arrival.via)
            if wire is not None:
                statement = parse(wire)
                with self.boundary.guard(arrival.via + statement.signer, now.mono_s):
                    self._take_control(arrival, header.kind, statement, now)
            return
        neighbour = self._sender(arrival)  # nor is anything answered or looked for in their name
        if header.destination == self.name:
            self._take_own(header, arrival, now)
        else:
            frame = arrival.frame[: HEADER_BYTES + header.length]
            sought = self.unicast.miss(header, frame, neighbour, now.mono_s)
            if sought is not None and self.resolver.cache.serves_stale:
                self.relocations.ask_neighbour(sought, neighbour, now.mono_s)
            self.relocations.frame_came(Name(header.destination), neighbour, now.mono_s)

    def _take_control(self, arrival: Arrival, kind: int, statement: Statement, now: Instant) -> None:
        if kind == Kind.HELLO:
            change = self.greeter.receive(arrival, statement, now)
            if change is not None:
                self._neighbour_changed(change, now.mono_s)
            known = self.greeter.neighbour(arrival.port, statement.signer)
            if known is not None and known.role.is_switch and not self._flooding.is_in_step(known):
                self._flooding.sync(known, now.mono_s)
            return
        neighbour = self._sender(arrival)
        if kind == Kind.LINK_STATE:
            if not neighbour.role.is_switch:
                raise StatementError(DropReason.NOT_DELEGATED, "only switches speak of links")
            self._flooding.receive(neighbour, statement, now)
        elif kind in (Kind.ADVERTISE, Kind.WITHDRAW):
            if not self._claim_paces.take(neighbour.name, now.mono_s):
                raise StatementError(DropReason.QUOTA, "claims of one neighbour")  # it is told nothing: that costs, too
            take = self._claims.take if kind == Kind.ADVERTISE else self._claims.withdraw
            take(neighbour, statement, now)
        elif kind in (Kind.JOIN, Kind.LEAVE):
            self._take_join(neighbour, statement, now)
        elif kind == Kind.REVOKE:
            self._unwatch(self._revoker.take(statement, neighbour, now))
        elif kind == Kind.REVOKED:
            self._take_revoked(neighbour, statement, now)
        elif kind == Kind.REDIRECT:
            self._redirected(statement, now)
        elif kind == Kind.WHERE:
            self._where(neighbour, statement, now)
        else:
            raise FrameError(DropReason.UNKNOWN_KIND, str(kind))

    def _sender(self, arrival: Arrival) -> Neighbour:
        """Return the neighbour with the sender's address.

        Raises:
            FrameError: UNKNOWN_SENDER, it is not up.
        """
        port = self.greeter.ports.get(arrival.port)
        for neighbour in port.neighbours.values() if port is not None else ():
            if neighbour.mac == arrival.mac and neighbour.state is NeighbourState.UP:
                return neighbour
        raise FrameError(DropReason.UNKNOWN_SENDER)

    def _take_own(self, header: Header, arrival: Arrival, now: Instant) -> None:
        if header.kind in (Kind.RIB_ANSWER, Kind.RELOCATE):
            wire = self._joiner.add(header, arrival.frame, now.mono_s, arrival.via)
            if wire is None:
                return
            opened: Opened | None = Opened(wire, is_fresh=False)
            if header.kind == Kind.RIB_ANSWER:
                opened = self.inquirer.open(wire, Name(header.source), now)
            if opened is None:
                return
            statement = parse(opened.wire)
            if opened.is_fresh and statement.signer != header.source:
                raise StatementError(DropReason.UNKNOWN_SENDER, "signed by another than its sender")
            with self.boundary.guard(arrival.via + statement.signer, now.mono_s):
                if header.kind == Kind.RIB_ANSWER and statement.type is StatementType.RELAY:
                    revocation, rib = self.inquirer.revocation_in(statement, now)
                    self._unwatch(self._revoker.take_from_rib(revocation, rib, now))
                elif header.kind == Kind.RIB_ANSWER:
                    self.inquirer.receive(statement, now, is_fresh=opened.is_fresh)
                else:
                    self._relocated(statement, now)
        elif header.kind == Kind.ECHO_REQUEST:
            back = header._replace(
                kind=Kind.ECHO_REPLY, hops_left=HOPS_MAX, destination=header.source, source=self.name,
                incarnation=self._incarnation,
            )  # fmt: skip
            reply = encode(back) + arrival.frame[HEADER_BYTES : HEADER_BYTES + header.length]
            self.unicast.send([reply], Name(header.source), self.name, now.mono_s)
        else:
            raise FrameError(DropReason.NOT_FOR_US, str(header.kind))

    # -- neighbours and links

    def _neighbour_changed(self, change: Change, now_s: float) -> None:
        neighbour, before = change
        if NeighbourState.UP in (neighbour.state, before):
            self._flooding.neighbour_changed(now_s)
        if neighbour.state is not before:
            self._neighbour_moved(change, now_s)
        self.planter.link_resized(neighbour.port)

    def _neighbour_moved(self, change: Change, now_s: float) -> None:
        """Greet who came up, and let go of who is gone."""
        neighbour, before = change
        if neighbour.state is NeighbourState.UP:
            self._sync.neighbour_up(neighbour, now_s)
            self.planter.neighbour_up((neighbour.port, neighbour.mac), now_s)
            self._seen_version = -1  # it may have another address now: what leads to it is computed anew
            if neighbour.role.is_switch:
                self._flooding.sync(neighbour, now_s)
        elif before is NeighbourState.UP:
            self._sync.neighbour_lost(neighbour)
            if neighbour.role.is_switch:
                self._flooding.damping.went((neighbour.port, neighbour.name), now_s)
            self.planter.neighbour_lost((neighbour.port, neighbour.mac), now_s)
            for attachment in self.attached.of(neighbour.name):
                if attachment.port == neighbour.port:
                    self.relocations.departed(attachment.claim, now_s)
                    self.attached.remove(attachment.claim.name, neighbour.name)
                    self.unicast.forget(attachment.claim.name)

    def _plan_follow(self, now_s: float) -> None:
        """See that a change of the links is followed soon, together with those that come right behind it.

        Link states come in bursts (``spf_delay.py``).
        """
        if self._spf_delay.due_s is None and self._flooding.link_states.version != self._seen_version:
            self._spf_delay.news(now_s)

    def _follow_links(self, now_s: float) -> None:
        """Let everything that depends on paths follow a change of the links."""
        self._spf_delay.computed()
        version = self._flooding.link_states.version
        if version == self._seen_version:
            return
        self._flooding.neighbour_changed(now_s)  # what lies inside our domain may have moved
        self._seen_version = self._flooding.link_states.version
        self._followed_s = now_s
        self._paths.has_alternates, self._protect_at_s = False, now_s + _PROTECT_S
        self.unicast.refresh(now_s)
        self.planter.reroute(now_s)
        self.inquirer.links_changed(now_s)
        self._look_for_rivals(now_s)

    def _life_elsewhere(self, name: Name) -> bytes | None:
        role = Role.SWITCH if self._paths.is_switch(name) else Role.RIB
        return self._paths.life_of(name, role)

    def _look_for_rivals(self, now_s: float) -> None:
        """Let RIBs go that an older node with their identity outlives elsewhere; tell those that younger ones copy."""
        self._rivals_sought_s = now_s
        for neighbour in self.greeter.all_up():
            elsewhere = self._life_elsewhere(neighbour.name) if neighbour.role is Role.RIB else None
            if elsewhere is not None and elsewhere < neighbour.life:
                self.greeter.let_go(neighbour, now_s)
        for name in self._paths.refused_elsewhere():
            self.greeter.tell_rivals(name, now_s)
            if name == self.name:
                self.greeter.note_clash(name, now_s)

    def _send_link_state(self, neighbour: Neighbour, wire: bytes) -> None:
        self._outbox.say(neighbour, Kind.LINK_STATE, wire)

    # -- moved nodes

    def _relocated(self, statement: Statement, now: Instant) -> None:
        """Take from the new switch of a node that was attached here where it is, and tell whom it hears."""
        place = self._evidence.from_relay(statement, now)
        if place.right in HEARS and self.planter.reader_moved(place):
            self.resolver.unwatch(place.name)
        self._locations.acknowledge_relocation(place, now.mono_s)
        if place.right is not Right.READ and self._locations.is_newer(place):
            self._locations.receive(place, statement.wire, now.mono_s)

    def _redirected(self, statement: Statement, now: Instant) -> None:
        """Take from a neighbour, to whom our frames for a node went, where that node is now."""
        if statement.type is StatementType.RELAY:
            place = self._evidence.from_relay(statement, now)
        else:
            place = self.inquirer.verify_answer(statement, now)
        if self._locations.is_newer(place):
            is_known = self._locations.get(place.name, place.advertiser) is not None
            has_moved = is_known or self.planter.trees.get(place.name, place.advertiser) is not None
            self._locations.receive(place, statement.wire, now.mono_s)
            if has_moved:
                self.relocations.moved(place, statement.wire, now.mono_s)

    def _where(self, neighbour: Neighbour, statement: Statement, now: Instant) -> None:
        """Tell a neighbour, to whom our frames for a node go, where that node is."""
        query = Query.from_fields(statement.expect(StatementType.QUERY))
        if not neighbour.role.is_switch or statement.signer != neighbour.name:
            raise StatementError(DropReason.UNKNOWN_SENDER, "a question that a neighbouring switch did not ask")
        statement.verify(neighbour.key)
        for known in self._locations.proofs_of(query.name, now.mono_s):
            self._outbox.say(neighbour, Kind.REDIRECT, known)

    # -- trees

    def _take_join(self, neighbour: Neighbour, statement: Statement, now: Instant) -> None:
        join = Join.from_fields(statement.expect(StatementType.JOIN))
        if not neighbour.role.is_switch or statement.signer != neighbour.name:
            raise StatementError(DropReason.UNKNOWN_SENDER, "a join is from a neighbouring switch")
        if not self._join_paces.take(neighbour.name, now.mono_s):
            raise StatementError(DropReason.QUOTA, "joins of one neighbour")
        statement.verify(neighbour.key)
        self.greeter.ports[neighbour.port].take_join(join, neighbour)
        if join.lease_s > 0:
            claim = self._evidence.of_join(join, now)
            if neighbour.role is Role.LEAF and claim.switch != neighbour.name:
                raise StatementError(DropReason.THROUGH_LEAF, "a leaf that joins for a node of another switch")
            self._held.note_branch(join.topic, join.publisher, (neighbour.port, neighbour.mac), claim)
        if self.planter.join(join, neighbour, now.mono_s):
            self.relocations.redirect_join(join.topic, join.publisher, neighbour, now.mono_s)
