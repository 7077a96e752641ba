"""Control plane of a switch: it handles neighbours' statements, queries its RIB, and writes the forwarding table.

Sans-I/O; an I/O layer or a simulated network passes in the frames that the data plane punts, and the time.

The path of a punted frame::

    kind >= 0x80    -> reassembled statement -> hello, or the handler of its kind (``_handlers``)
    addressed to us -> a RIB's response, or an echo
    anything else   -> no entry yet: Unicast finds the path, or buffers the frame and sends a query
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final

from gdp.control.boundary import ErrorBoundary
from gdp.control.channel import Channels, Opened
from gdp.control.diagnostics import Diagnostics
from gdp.control.fragments import ControlFragmenter, ControlReassembler
from gdp.control.hello import NodeSettings
from gdp.control.neighbour import Neighbour, NeighbourState
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.control.neighbour_table import Change
from gdp.control.waiting import Wait, WaitReason, port_waits, stranger_waits
from gdp.crypto.certificates import Role
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.due_queue import earliest
from gdp.errors import DropReason, FrameError, RemoteError, StatementError
from gdp.frame.codec import CONTROL_FROM, HEADER_BYTES, HOPS_AT, HOPS_MASK, SECOND_PATH, Header, Kind, decode, encode
from gdp.limits import HOPS_MAX
from gdp.names import Name
from gdp.sansio import OutgoingFrames, ReceivedFrame, Timestamps
from gdp.switch.advertisements import AdvertisementHandler
from gdp.switch.diagnostic_answers import DiagnosticAnswers
from gdp.switch.flooding import Flooding
from gdp.switch.forwarding_state import ForwardingState
from gdp.switch.join_handler import JoinHandler
from gdp.switch.location_updates import LocationUpdates
from gdp.switch.lsdb import LinkStateDatabase
from gdp.switch.multicast import MulticastTrees
from gdp.switch.name_resolver import owner_of
from gdp.switch.outbox import Outbox
from gdp.switch.path_updates import PathUpdates
from gdp.switch.paths import Paths
from gdp.switch.relocation import Relocations
from gdp.switch.revocations import RevocationHandler
from gdp.switch.rib_client import RibClient
from gdp.switch.table import Table
from gdp.switch.tunnel_planner import TunnelPlanner
from gdp.switch.unicast import Unicast
from gdp.trust.domain import Policy

_CONTROL: Final = frozenset(kind.value for kind in Kind if kind >= CONTROL_FROM)

StatementHandler = Callable[[Neighbour, Statement, Timestamps], object]


class SwitchCore:
    """Sans-I/O core of one switch.

    Attributes:
        state: what its parts share.
        tunnels: plans the direct tunnels.
    """

    def __init__(self, identity: Identity, policy: Policy, table: Table, settings: NodeSettings) -> None:
        fragmenter = ControlFragmenter(identity.name, settings.incarnation)
        link_states = LinkStateDatabase(identity.member.domain)
        self.paths = Paths(identity.name, identity.member.domain, link_states)
        self.hello_protocol = HelloProtocol(
            identity,
            policy,
            fragmenter,
            settings,
            digest_for=link_states.digest_for,
            incarnation_elsewhere=self.paths.incarnation_elsewhere,
            is_only_way=self.paths.is_only_way,
        )
        self.offload = self.hello_protocol.offload
        self.offload.on_runs = self._follow_runs
        neighbours = self.hello_protocol.neighbours
        state = ForwardingState(
            identity,
            policy,
            table=table,
            paths=self.paths,
            neighbours=neighbours,
            outbox=Outbox(neighbours, fragmenter),
            lease_s=settings.lease_s,
        )
        self.state = state
        self.name = state.me
        self.table = table
        self.attached = state.attached
        self.resolver = state.resolver
        self._incarnation = settings.incarnation
        self._reassembler = ControlReassembler()
        self._flooding = Flooding(state, self.hello_protocol.conflicts, settings)
        self.multicast = MulticastTrees(state, settings.first_sequence)
        self.unicast = Unicast(state)
        self._revoker = RevocationHandler(
            state, self.hello_protocol, self.multicast, self.unicast, settings.first_sequence
        )
        self.relocations = Relocations(state, self.multicast, self.unicast)
        self._channels = Channels(identity, policy, settings.random_bytes, accepts=False)
        self._locations = LocationUpdates(state, self.multicast, self.unicast, self.relocations)
        self.rib_client = RibClient(state, self._channels, self.unicast, self.relocations, self._locations)
        self.tunnels = TunnelPlanner(state, self.rib_client.endpoints, self._wake)
        self._path_updates = PathUpdates(
            state,
            flooding=self._flooding,
            hello_protocol=self.hello_protocol,
            multicast=self.multicast,
            unicast=self.unicast,
            rib_client=self.rib_client,
            locations=self._locations,
        )
        self._handlers = self._statement_handlers()
        self.diagnostics = Diagnostics(
            identity,
            policy,
            fragmenter,
            settings.first_sequence,
            lambda frames, to, now: self.unicast.forward(to, identity.name, frames, now.mono_s),
        )
        self.diagnostic_answers = DiagnosticAnswers(state, self.diagnostics, self._wake)
        self.boundary = ErrorBoundary()
        self._drops: Counter[DropReason] = Counter()
        # when something other than the neighbour discovery is due; None: to be computed
        self._rest_due_s: float | None = None

    def _statement_handlers(self) -> dict[int, StatementHandler]:
        """Return what handles a neighbour's statement, by the kind of its frames."""
        advertisements = AdvertisementHandler(
            self.state,
            multicast=self.multicast,
            unicast=self.unicast,
            rib_client=self.rib_client,
            locations=self._locations,
            relocations=self.relocations,
        )
        joins = JoinHandler(self.state, self.multicast, self.relocations)
        return {
            Kind.LINK_STATE: self._flooding.receive,
            Kind.ADVERTISE: advertisements.receive_advertisement,
            Kind.WITHDRAW: advertisements.receive_withdrawal,
            Kind.JOIN: joins.handle_join,
            Kind.LEAVE: joins.handle_join,
            Kind.JOIN_REFRESH: joins.handle_refresh,
            Kind.PACE: joins.handle_pace,
            Kind.REVOKE: self._revoker.receive_revocation,
            Kind.REVOKED: self._revoker.receive_sync,
            Kind.REDIRECT: self._locations.receive_redirect,
            Kind.WHERE: self._locations.answer_query,
        }

    @property
    def rib(self) -> Name | None:
        """Return the RIB that receives the queries, or None while none is known."""
        return self.rib_client.rib

    @property
    def is_displaced(self) -> bool:
        """Return whether an older switch with this identity is alive, so that this one must end."""
        return self._flooding.is_displaced

    def waits(self, attachments: Collection[int], now_s: float) -> list[Wait]:
        """Return the conditions that are missing before this switch can serve; empty when none is.

        Args:
            attachments: ports made for nodes of the same host, which may start at any time: an empty one is no reason
                to wait.
        """
        waits = list(stranger_waits(self.hello_protocol, now_s))
        refusing = {wait.port for wait in waits}
        for port in self.hello_protocol.ports.values():
            if port.index not in attachments:
                found = port_waits(port, tuple(Role))
                waits += (each for each in found if port.index not in refusing or each.reason is WaitReason.LINK_DOWN)
        if severed := self.paths.severed():
            waits.append(Wait(WaitReason.THROUGH_LEAF, name=min(severed)))
        if self.rib is None:
            waits.append(Wait(WaitReason.NO_RIB))
        return waits

    def drops(self) -> Mapping[DropReason, int]:
        """Return what the control plane dropped, by reason."""
        own = self._drops + self._reassembler.drops + self.hello_protocol.drops + self._channels.drops
        own += self.diagnostics.drops
        return own + self._flooding.drops + self.resolver.pending.drops + self.multicast.drops + self.unicast.drops

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        """Add a port, or update the MTU or cost of one that is up."""
        self._rest_due_s = None
        self.state.now = now
        changes = self.hello_protocol.add_port(index, mac, mtu, cost, now.mono_s)
        for change in changes:
            self._neighbour_changed(change, now.mono_s)
        if changes:
            self._path_updates.follow(now.mono_s)

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        """Handle a change of a port's link."""
        self._rest_due_s = None
        self.state.now = now
        for change in self.hello_protocol.port_changed(port, up, now.mono_s):
            self._neighbour_changed(change, now.mono_s)
        self._path_updates.follow(now.mono_s)  # at once: frames over this link would be lost

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        """Handle frames that the data plane punted."""
        has_control = has_data = False
        self.state.now = now
        for arrival in arrivals:
            try:
                header = decode(arrival.frame)
                if header.kind == Kind.KEEPALIVE:
                    self._heard([self.hello_protocol.receive_keepalive(arrival, header, now)], now)
                elif header.kind >= CONTROL_FROM:
                    has_control |= self._receive_control(arrival, header, now)
                else:
                    has_data |= self._receive_data(arrival, header, now)
            except RemoteError as error:
                has_control = True
                self._drops[error.reason] += 1
            except Exception as error:  # one frame must not stop the switch
                has_control = True
                self.boundary.record(error)
                self._drops[DropReason.INTERNAL] += 1
        if recosted := self.hello_protocol.neighbours.poll_costs():
            has_control = True
            for change in recosted:
                self._neighbour_changed(change, now.mono_s)
        if has_control:  # neighbours, links and identities change by nothing else
            self.rib_client.presence.answer(now.mono_s)
            self._flooding.tell_of_conflicts(now.mono_s)
            self._path_updates.plan(now.mono_s)
        if has_control or has_data:
            self._rest_due_s = None
            self.diagnostics.answer_waiting(now)

    def handle_timer(self, now: Timestamps) -> None:
        """Run the timers that are due."""
        now_s = now.mono_s
        self.state.now = now
        lost = self.hello_protocol.drop_silent(now_s)
        for change in lost:
            self._neighbour_changed(change, now_s)
        self.state.outbox.waiting += self.hello_protocol.hellos_to_send(now_s)
        self.diagnostics.handle_timer(now)
        if not lost and self._rest_due_s is not None and now_s < self._rest_due_s:
            return  # most due timers are keepalives
        self._rest_due_s = None
        self._flooding.handle_timer(now_s)
        self._path_updates.handle_timer(now_s, has_lost=bool(lost))
        self._reassembler.drop_expired(now_s)
        self._locations.expire(now_s)
        for key in self.table.expire(now_s):
            self.unicast.entry_removed(key)
        for attachment in self.attached.expire(now_s):
            self.unicast.remove(attachment.advertisement.name)
        self.multicast.handle_timer(now_s)
        self.relocations.handle_timer(now_s)
        self.rib_client.send_due(now_s)
        self._revoker.sync.handle_timer(now_s)
        self._tell_rib_of_revocations(now_s)
        self.rib_client.presence.answer(now_s)
        self.diagnostics.answer_waiting(now)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        if self._rest_due_s is None:
            self._rest_due_s = self._next_of_rest()
        return earliest(self._rest_due_s, self.hello_protocol.get_timer(), self.diagnostics.get_timer())

    def _next_of_rest(self) -> float:
        """Return the monotonic second of the next timer outside neighbour discovery."""
        times = [
            self._path_updates.get_timer(),
            self._flooding.get_timer(),
            self.table.next_expiry(),
            self.multicast.get_timer(),
            self.resolver.next_expiry(),
            self.relocations.get_timer(),
            self.rib_client.get_timer(),
            self._revoker.sync.get_timer(),
        ]
        if self.rib_client.rib is not None:
            times.append(self._revoker.next_due_for_rib())
        if self.rib_client.rib is None:
            times.append(self.attached.next_expiry())
        return min(time for time in times if time is not None)

    def query_name(self, name: Name, now_s: float) -> None:
        """Query a name at the RIB at once, known or not, for a tool of this machine."""
        self.resolver.request(name, now_s)
        self.rib_client.send_due(now_s)
        self._rest_due_s = None

    def count_arrivals(self, frames_from: Callable[[int], int]) -> None:
        """Learn how to count the frames that have come from a port."""
        self.hello_protocol.liveness.count_arrivals(frames_from)

    def poll_neighbours(self) -> Mapping[int, frozenset[bytes]]:
        """Return, once, the addresses of neighbours, former ones too, at each port where they have changed."""
        return self.hello_protocol.neighbours.poll_addresses()

    def frames_to_send(self, now_s: float) -> list[OutgoingFrames]:
        """Return, once, the frames to send: none while an older switch has this identity."""
        del now_s  # nothing here is paced
        return [] if self.is_displaced else self.state.outbox.poll_frames()

    def frames_sent(self, now_s: float) -> None:
        """Do nothing: no path is measured here."""

    def _wake(self) -> None:
        """Note that a timer outside neighbour discovery has changed."""
        self._rest_due_s = None

    def _tell_rib_of_revocations(self, now_s: float) -> None:
        """Send the RIB the revocations that the operator submitted."""
        if self.rib_client.rib is not None:
            for wire in self._revoker.due_for_rib(self.rib_client.rib, now_s):
                self.rib_client.relay(wire, now_s)

    def revoke(self, wire: bytes, now: Timestamps) -> None:
        """Handle a revocation from this node's operator, and distribute it.

        Raises:
            StatementError: it is not valid.
        """
        self._rest_due_s = None
        self._revoker.hand_in(parse(wire), now)
        self._tell_rib_of_revocations(now.mono_s)

    # -- frames

    def _follow_runs(self, heard: list[Neighbour], now: Timestamps) -> None:
        """Follow what a data plane reports on keepalive sessions."""
        self._heard(heard, now)
        self.receive((), now)

    def _heard(self, neighbours: list[Neighbour], now: Timestamps) -> None:
        for neighbour in neighbours:
            if neighbour.name in self.rib_client.presence.open:
                self.rib_client.presence.answer(now.mono_s)
            if neighbour.role.is_switch:
                self._flooding.compare(neighbour, now.mono_s)

    def _receive_control(self, arrival: ReceivedFrame, header: Header, now: Timestamps) -> bool:
        """Handle a neighbour's control frame; return False if it is a fragment whose statement is not complete."""
        if header.kind not in _CONTROL:
            raise FrameError(DropReason.UNKNOWN_KIND, str(header.kind))
        if header.kind == Kind.COOKIE:
            self.hello_protocol.receive_cookie(arrival, header)
            return True
        if header.kind == Kind.HELLO:
            wire = self.hello_protocol.reception.join(arrival, header, now.mono_s)
        else:
            self._sender(arrival)  # unknown senders get no state
            wire = self._reassembler.add(header, arrival.frame, now.mono_s, arrival.via)
        if wire is not None:
            statement = parse(wire)
            with self.boundary.guard(arrival.via + statement.signer, now.mono_s):
                self._take_control(arrival, header.kind, statement, now)
        return wire is not None

    def _receive_data(self, arrival: ReceivedFrame, header: Header, now: Timestamps) -> bool:
        """Handle a frame that is for a name; return False if it is a fragment whose statement is not complete."""
        neighbour = self._sender(arrival)  # their frames cause no response and no query
        if header.kind == Kind.DIAGNOSTIC_REQUEST and header.hops_left & HOPS_MASK <= 1:
            if self.state.trees.of_topic(Name(header.destination)):
                raise FrameError(DropReason.NOT_FOR_US, "a request that a tree has copied")
            self.diagnostics.receive(header, arrival, now, neighbour.name)
        elif header.destination == self.name:
            return self._take_own(header, arrival, now)
        elif header.hops_left & SECOND_PATH:
            raise FrameError(DropReason.NO_SECOND_PATH)  # nothing is asked for it: the first copy travels anyway
        else:
            frame = arrival.frame[: HEADER_BYTES + header.length]
            destination, source = Name(header.destination), Name(header.source)
            leaving = frame[:HOPS_AT] + bytes([max(frame[HOPS_AT] - 1, 0)]) + frame[HOPS_AT + 1 :]
            sought = self.unicast.forward(destination, source, [leaving], now.mono_s, owner_of(neighbour))
            if sought is not None and self.resolver.cache.serves_stale:
                self.relocations.ask_neighbour(sought, neighbour, now.mono_s)
            if header.destination in self.relocations.moved_names:
                self.relocations.frame_came(destination, neighbour, now.mono_s)
        return True

    def _take_control(self, arrival: ReceivedFrame, kind: int, statement: Statement, now: Timestamps) -> None:
        if kind == Kind.HELLO:
            change = self.hello_protocol.receive(arrival, statement, now)
            if change is not None:
                # ahead of all that the far end takes only from a neighbour that is up
                self.state.outbox.waiting += self.hello_protocol.hellos_to_send(now.mono_s)
                self._neighbour_changed(change, now.mono_s)
            known = self.hello_protocol.neighbours.get(arrival.port, statement.signer)
            if known is not None and known.role.is_switch and not self._flooding.is_in_step(known):
                self._flooding.sync(known, now.mono_s)
            return
        neighbour = self._sender(arrival)
        handle = self._handlers.get(kind)
        if handle is None:
            raise FrameError(DropReason.UNKNOWN_KIND, str(kind))
        handle(neighbour, statement, now)

    def _sender(self, arrival: ReceivedFrame) -> Neighbour:
        """Return the neighbour with the sender's address. Raises ``FrameError``: UNKNOWN_SENDER, it is not up."""
        neighbour = self.state.neighbours.neighbour_at(arrival.port, arrival.mac, is_up=True)
        if neighbour is None:
            raise FrameError(DropReason.UNKNOWN_SENDER)
        return neighbour

    def _take_own(self, header: Header, arrival: ReceivedFrame, now: Timestamps) -> bool:
        """Handle a frame that is for this switch; return False if it is a fragment whose statement is not complete."""
        if header.kind in (Kind.RIB_ANSWER, Kind.RELOCATE):
            wire = self._reassembler.add(header, arrival.frame, now.mono_s, arrival.via)
            if wire is None:
                return False
            opened: Opened | None = Opened(wire, is_fresh=False)
            if header.kind == Kind.RIB_ANSWER:
                opened = self.rib_client.open(wire, Name(header.source), now)
            if opened is None:
                return True
            statement = parse(opened.wire)
            if opened.is_fresh and statement.signer != header.source:
                raise StatementError(DropReason.UNKNOWN_SENDER, "signed by another than its sender")
            with self.boundary.guard(arrival.via + statement.signer, now.mono_s):
                if header.kind == Kind.RIB_ANSWER and statement.type is StatementType.RELAY:
                    revocation, rib = self.rib_client.revocation_in(statement, now)
                    self._revoker.receive_from_rib(revocation, rib, now)
                elif header.kind == Kind.RIB_ANSWER:
                    self.rib_client.receive(statement, now, is_fresh=opened.is_fresh)
                else:
                    self._locations.receive_relocation(statement, now)
        elif header.kind == Kind.ECHO_REQUEST:
            back = header._replace(
                kind=Kind.ECHO_REPLY, hops_left=HOPS_MAX, destination=header.source, source=self.name,
                incarnation=self._incarnation,
            )  # fmt: skip
            reply = encode(back) + arrival.frame[HEADER_BYTES : HEADER_BYTES + header.length]
            self.unicast.send([reply], Name(header.source), self.name, now.mono_s)
        elif header.kind in (Kind.DIAGNOSTIC_REQUEST, Kind.DIAGNOSTIC_REPLY):
            self.diagnostics.receive(header, arrival, now, self._sender(arrival).name)
        else:
            raise FrameError(DropReason.NOT_FOR_US, str(header.kind))
        return True

    # -- neighbours and links

    def _neighbour_changed(self, change: Change, now_s: float) -> None:
        neighbour, before = change
        if NeighbourState.UP in (neighbour.state, before):
            self._flooding.neighbour_changed(now_s)
        if neighbour.state is not before:
            self._neighbour_moved(change, now_s)
        self.multicast.link_resized(neighbour.port)

    def _neighbour_moved(self, change: Change, now_s: float) -> None:
        """Send the present state to a neighbour that came up, and remove the state of one that is gone."""
        neighbour, before = change
        if neighbour.state is NeighbourState.UP:
            self._revoker.sync.neighbour_up(neighbour, now_s)
            self.multicast.neighbour_up((neighbour.port, neighbour.mac), now_s)
            self._path_updates.neighbour_came()
            if neighbour.role.is_switch:
                self._flooding.sync(neighbour, now_s)
        elif before is NeighbourState.UP:
            self._revoker.sync.neighbour_lost(neighbour)
            if neighbour.role.is_switch:
                self._flooding.damping.went((neighbour.port, neighbour.name), now_s)
            self.multicast.neighbour_lost((neighbour.port, neighbour.mac), now_s)
            for attachment in self.attached.of(neighbour.name):
                if attachment.port == neighbour.port:
                    self.attached.depart(attachment.advertisement.name, neighbour.name, now_s)
                    self.unicast.remove(attachment.advertisement.name)
