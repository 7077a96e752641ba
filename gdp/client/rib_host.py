"""RIB node on the overlay: the RIB's protocol core with an attachment to a switch.

Sans-I/O; an I/O layer or a simulated network passes it frames and time. A RIB advertises no name: its hello states its
role, and its switch announces it in its link state (``control/link_state.py``).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from gdp.client.attachment import Attachment
from gdp.control.channel import Channels
from gdp.control.diagnostics import Diagnostics
from gdp.control.fragments import ControlReassembler
from gdp.control.hello import NodeSettings
from gdp.crypto.identity import Identity
from gdp.crypto.statements import Statement, StatementType, parse
from gdp.due_queue import earliest
from gdp.errors import DropReason, FrameError, RemoteError
from gdp.frame.codec import CONTROL_FROM, Kind, decode
from gdp.names import Name
from gdp.rib.core import RibCore
from gdp.sansio import OutgoingFrames, ReceivedFrame, Timestamps
from gdp.trust.domain import Policy
from gdp.trust.revocation import Revocation


class RibHost:
    """Protocol core of a RIB node."""

    def __init__(self, identity: Identity, policy: Policy, rib: RibCore, settings: NodeSettings) -> None:
        self.name = identity.name
        self._reassembler = ControlReassembler()
        self._drops: Counter[DropReason] = Counter()
        self._is_connected = False
        self._now_s = 0.0  # of the last call
        self._channels = Channels(identity, policy, settings.random_bytes, accepts=True)
        self.attachment = Attachment(identity, policy, settings)
        self.offload = self.attachment.hello_protocol.offload
        self.rib = rib
        self.boundary = rib.boundary
        self.diagnostics = Diagnostics(
            identity,
            policy,
            self.attachment.fragmenter,
            settings.first_sequence,
            lambda frames, _to, _now: self.attachment.send(frames),
        )

    def drops(self) -> Mapping[DropReason, int]:
        """Return what was dropped or refused, by reason."""
        own = self._drops + self._reassembler.drops + self._channels.drops + self.diagnostics.drops
        return own + self.attachment.drops + self.rib.state.refusals

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        """Begin to discover a switch on a port."""
        self.attachment.hello_protocol.add_port(index, mac, mtu, cost, now.mono_s)

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        """Process received frames."""
        self._now_s = now.mono_s
        others = 0  # keepalives, and fragments whose statement is not complete
        statements: list[tuple[bytes, Name]] = []
        for arrival in arrivals:
            try:
                others += not self._receive_frame(arrival, statements, now)
            except RemoteError as error:
                self._drops[error.reason] += 1
            except Exception as error:  # one frame must not end the RIB
                self.rib.boundary.record(error)
                self._drops[DropReason.INTERNAL] += 1
        if others < len(arrivals):
            self.rib.receive_all(statements, now)
            self._record_connection(now)
            self._post()

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        """Update the state of a port's link."""
        self.attachment.port_changed(port, up, now)

    def handle_timer(self, now: Timestamps) -> None:
        """Process the timers that are due."""
        self._now_s = now.mono_s
        self.attachment.handle_timer(now)
        self._record_connection(now)
        due_s = self._next_of_rest()
        if due_s is not None and now.mono_s >= due_s:  # most due timers are keepalives
            self.diagnostics.handle_timer(now)
            self._reassembler.drop_expired(now.mono_s)
            self.rib.handle_timer(now)
            self._channels.handle_timer(now.mono_s)
        self._post()

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return earliest(self.attachment.get_timer(), self._next_of_rest())

    def _next_of_rest(self) -> float | None:
        """Return the monotonic second of the next timer outside the attachment, or None."""
        return earliest(self.rib.get_timer(), self._channels.get_timer(), self.diagnostics.get_timer())

    def count_arrivals(self, frames_from: Callable[[int], int]) -> None:
        """Learn how to count the frames that have come from a port."""
        self.attachment.hello_protocol.liveness.count_arrivals(frames_from)

    def poll_neighbours(self) -> Mapping[int, frozenset[bytes]]:
        """Return, once, the addresses of neighbours, former ones too, at each port where they have changed."""
        return self.attachment.hello_protocol.neighbours.poll_addresses()

    def frames_to_send(self, now_s: float) -> list[OutgoingFrames]:
        """Return, once, the frames to send."""
        del now_s  # nothing here is paced
        frames, self.attachment.outgoing = self.attachment.outgoing, []
        return frames

    def frames_sent(self, now_s: float) -> None:
        """Do nothing: no path is measured here."""

    def _receive_frame(self, arrival: ReceivedFrame, statements: list[tuple[bytes, Name]], now: Timestamps) -> bool:
        """Add the statement for the RIB that a frame completes, with its sender; return whether one does."""
        header = decode(arrival.frame)
        if header.kind == Kind.KEEPALIVE:
            self.attachment.hello_protocol.receive_keepalive(arrival, header, now)
            return False
        if header.kind >= CONTROL_FROM:
            statement = self.attachment.receive_control(arrival, header, now)
            if statement is not None and statement.type is StatementType.REVOKE:
                self._handle_revocation(statement, now)
            return True
        if header.destination != self.name:
            raise FrameError(DropReason.NOT_FOR_US)
        if header.kind in (Kind.DIAGNOSTIC_REQUEST, Kind.DIAGNOSTIC_REPLY):
            self.diagnostics.receive(header, arrival, now)
            return True
        if header.kind not in (Kind.RIB_REQUEST, Kind.RIB_ANSWER):
            raise FrameError(DropReason.UNKNOWN_KIND, str(header.kind))
        if (wire := self._reassembler.add(header, arrival.frame, now.mono_s, arrival.via)) is None:
            return False
        sender = Name(header.source)
        if (opened := self._channels.receive(wire, sender, now)) is None:
            return True
        if not opened.is_fresh and parse(opened.wire).type is not StatementType.PRESENCE:
            raise FrameError(DropReason.NO_CHANNEL, "a statement that may be a recorded one")
        statements.append((opened.wire, sender))
        return True

    def _handle_revocation(self, statement: Statement, now: Timestamps) -> None:
        if (switch := self.attachment.switch) is not None:
            self.rib.revoke(statement.wire, switch.name, now)
            self.attachment.hello_protocol.recheck(Revocation.read(statement).fingerprint, now)

    def _record_connection(self, now: Timestamps) -> None:
        is_connected = self.attachment.switch is not None
        if is_connected and not self._is_connected:
            self.rib.connected(now)
        self._is_connected = is_connected

    def _post(self) -> None:
        letters = self.rib.statements_to_send()
        if self.attachment.switch is None:
            return  # no switch carries them: the querying node will query again
        for outgoing in letters:
            if outgoing.kind is Kind.RIB_REQUEST:
                self._channels.send_query(outgoing.to, outgoing.statement, self._now_s)
            elif not self._channels.send_response(outgoing.to, outgoing.statement):
                self.attachment.say(outgoing.kind, outgoing.statement, outgoing.to)  # a presence query, to any switch
        for each in self._channels.records_to_send():
            self.attachment.say(Kind.RIB_ANSWER if each.is_answer else Kind.RIB_REQUEST, each.wire, each.to)
