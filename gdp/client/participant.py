"""Participant of the overlay: publishes, reads, serves and calls names; the core of a proxy.

Sans-I/O; an I/O layer or a simulated network passes it frames and time, and takes out frames and messages.

A sent message passes ``publish``, the Publisher (number, seal, cache) and the switch. A received DATA or HEARTBEAT
frame passes the writer proxy of its topic and source, and leaves by ``poll_messages``. A node that serves or calls a
name both publishes and reads it. A server's responses to one client, and a client's requests to one server, use unicast
streams.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, TypedDict

from gdp.client.attachment import Attachment
from gdp.client.control_keys import ControlKeys
from gdp.client.identities import ReaderIdentity, WriterIdentity
from gdp.client.publications import Publications
from gdp.client.publisher import Publisher
from gdp.client.reader_proxies import CALLS, TOPICS
from gdp.client.reception import Reception
from gdp.client.send_options import DEFAULT_OPTIONS, PublisherSettings, SendOptions
from gdp.client.services import Services, StallClock
from gdp.client.subscription import Message, Subscription, Subscriptions, Topic
from gdp.client.unicast_stream import PeerIncarnation
from gdp.client.writer_proxy import WriterProxy
from gdp.control.boundary import ErrorBoundary
from gdp.control.diagnostics import Diagnostics, Question
from gdp.control.hello import NodeSettings
from gdp.control.join import Join
from gdp.control.rib_statements import Response
from gdp.crypto.exchange import EXCHANGE_KEY_BYTES, ExchangeKey
from gdp.crypto.identity import Identity
from gdp.crypto.introduction import Introduction
from gdp.crypto.statements import Statement, StatementType
from gdp.due_queue import earliest
from gdp.errors import DropReason, LocalError, RemoteError, StatementError
from gdp.frame.codec import CONTROL_FROM, Header, Kind, decode
from gdp.intervals import NEVER_S
from gdp.names import Name
from gdp.sansio import OutgoingFrames, ReceivedFrame, Timestamps
from gdp.trust.domain import Policy
from gdp.trust.right import Right
from gdp.trust.verifier import AdvertisementVerifier

if TYPE_CHECKING:
    from typing_extensions import Unpack

_FOR_WRITER_PROXIES: Final = (int(Kind.DATA), int(Kind.HEARTBEAT), int(Kind.PARITY))
_FOR_US: Final = tuple(map(int, (Kind.ACKNACK, Kind.INTRODUCTION, Kind.DIAGNOSTIC_REQUEST, Kind.DIAGNOSTIC_REPLY)))

__all__ = ["Message", "Participant", "ServiceOptions", "Topic"]


class ServiceOptions(TypedDict, total=False):
    """How a name is served or called.

    Attributes:
        is_global: other domains can find the name; the default.
        urgent: its frames go before others.
        paths: 2: each frame twice, over two disjoint paths where they exist.
        options: how its messages share the path.
        is_session: a session secret authenticates streams between one client and one server, if both ask for it.
    """

    is_global: bool
    urgent: bool
    paths: int
    options: SendOptions
    is_session: bool


class _Control:
    """Timers of attachment and diagnostics, which are read again only after something may have changed them.

    Attributes:
        due_s: monotonic second of the next one, or None; not valid while ``has_changed``.
        early_s: before this second they have nothing to do, and send nothing together with what others send.
    """

    def __init__(self, attachment: Attachment, diagnostics: Diagnostics) -> None:
        self._attachment = attachment
        self._diagnostics = diagnostics
        self.due_s: float | None = None
        self.early_s = -NEVER_S
        self.has_changed, self._is_settled = True, False

    def touch(self) -> Attachment:
        """Return the attachment to a caller that may change when something is due."""
        self.has_changed, self._is_settled = True, False
        return self._attachment

    def handle_timer(self, now: Timestamps) -> None:
        """Process the timers that are due."""
        self.touch().handle_timer(now)
        self._diagnostics.handle_timer(now)
        self._is_settled = True

    def read_timers(self) -> None:
        """Set when something is due."""
        due_s, waiting_s = self._attachment.get_timer(), self._diagnostics.get_timer()
        self.due_s, self.early_s, self.has_changed = earliest(due_s, waiting_s), -NEVER_S, False
        if self._is_settled and waiting_s is None:
            self.early_s = NEVER_S if due_s is None else due_s - self._attachment.hello_protocol.together_s


class Participant:
    """Protocol core of one participant.

    ``advertise``, ``serve``, ``call`` and ``subscribe`` raise ``LocalError`` without a delegation or a secret for the
    name, or if the name is in use here.

    Attributes:
        name: of the participant.
        publications: what it publishes, serves and calls.
        subscriptions: what it reads, serves and calls.
        services: peers of the names that it serves or calls.
        attachment: to its switch.
        diagnostics: questions to other nodes, and answers.
    """

    def __init__(self, identity: Identity, policy: Policy, settings: NodeSettings) -> None:
        self._identity = identity
        self.name = identity.name
        self._verifier = AdvertisementVerifier(policy)
        control_keys = ControlKeys(ExchangeKey.from_random(settings.random_bytes(EXCHANGE_KEY_BYTES)))
        source = WriterIdentity(identity.name, settings.incarnation, identity.key, settings.random_bytes, control_keys)
        self._introduced = (-1, b"")  # since when, and the introduction
        reader = ReaderIdentity(identity.name, settings.incarnation, control_keys, self._introduction)
        self.subscriptions = Subscriptions(reader, self._verifier)
        self.publications = Publications(source, self.subscriptions.party_of)
        self._scheduler = self.publications.scheduler
        self._clock = StallClock()
        self.services = Services(
            self.publications,
            self.subscriptions,
            self._clock,
            lambda name: self._control.touch().request_costs(name, Right.CALL),
        )
        self._sent_by: object = None  # the switch that carried the latest frames
        self.boundary = ErrorBoundary()
        self._drops: Counter[DropReason] = Counter()
        self._source = source
        self.attachment = Attachment(identity, policy, settings, control_keys.public)
        self._reception = Reception(self.subscriptions, self.attachment.send, self.attachment.state_pace)
        self.attachment.advertisement(identity.subject, Right.ATTACH, (), is_global=True)
        self.diagnostics = Diagnostics(
            identity, policy, self.attachment.fragmenter, settings.first_sequence,
            lambda frames, _to, _now: self._control.touch().send(frames),
        )  # fmt: skip
        self.diagnostics.register("ping", self._answer_ping, for_foreign=True)
        self.diagnostics.evidence_of = self.attachment.evidence_of
        self._control = _Control(self.attachment, self.diagnostics)
        self.offload = self.attachment.hello_protocol.offload
        self.offload.on_runs = lambda _heard, _now: self._control.touch()

    def drops(self) -> Mapping[DropReason, int]:
        """Return what was dropped, by reason."""
        attachment = self.attachment
        total = self._drops + self.subscriptions.drops + attachment.drops + attachment.refusals
        total += self.publications.drops + self.diagnostics.drops
        for writer_proxy in self.subscriptions.writer_proxies():
            total += writer_proxy.drops
        return total

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        """Begin to discover a switch on a port."""
        self._clock.advance(now.mono_s)
        self._control.touch().hello_protocol.add_port(index, mac, mtu, cost, now.mono_s)

    def advertise(
        self,
        topic: Topic,
        description: bytes,
        *,
        reliable: bool,
        depth: int = 0,
        is_global: bool = True,
        urgent: bool = False,
        paths: int = 1,
        options: SendOptions = DEFAULT_OPTIONS,
    ) -> Publisher:
        """Publish a topic from now on; ``paths`` 2: each frame twice, over two disjoint paths where they exist."""
        self._check(topic, Right.PUBLISH, is_free=topic.name not in self.publications)
        settings = PublisherSettings(reliable=reliable, depth=depth, urgent=urgent, paths=paths, options=options)
        publisher = self.publications.add(topic.name, topic.own_secrets, description, settings)
        self._control.touch().advertisement(
            topic.delegation.subject, Right.PUBLISH, topic.delegation.chain, is_global=is_global, paths=paths
        )
        return publisher

    def serve(self, topic: Topic, description: bytes, **options: Unpack[ServiceOptions]) -> Publisher:
        """Serve a name; return the stream that all its clients receive. ``services.respond`` sends to one."""
        return self._join_service(topic, Right.SERVE, description, **options)

    def call(self, topic: Topic, description: bytes, **options: Unpack[ServiceOptions]) -> Publisher:
        """Call a name from now on; return the stream of requests to all its servers. ``services.send_request``
        sends to one.

        A request that is published while ``services.peers`` is empty reaches no server.
        """
        return self._join_service(topic, Right.CALL, description, **options)

    def withdraw(self, name: Name) -> None:
        """Stop publishing, serving or calling a name; an unused name is ignored.

        The name may be used again at any time, also in another way.
        """
        if not self.publications.remove(name):
            return
        subscription = self.subscriptions.get(name)
        right = Right.PUBLISH
        if subscription is not None and subscription.right is not Right.READ:
            right = subscription.right
            self._close(self.subscriptions.remove(name))
        self._control.touch().withdraw(name, right)

    def subscribe(self, topic: Topic, *, paths: int = 1, head_bytes: int = 0) -> None:
        """Read a topic from now on, from every publisher of it; the others as in ``Subscription``."""
        self._check(topic, Right.READ, is_free=self.subscriptions.get(topic.name) is None)
        self.subscriptions.add(
            Subscription(topic=topic, right=Right.READ, since_s=self._clock.now_s, paths=paths, head_bytes=head_bytes)
        )
        self._control.touch().advertisement(
            topic.delegation.subject, Right.READ, topic.delegation.chain, is_global=False, paths=paths
        )

    def unsubscribe(self, name: Name) -> None:
        """Stop reading a topic; one that is not read is ignored. A later ``subscribe`` begins with new messages."""
        subscription = self.subscriptions.get(name)
        if subscription is not None and subscription.right is Right.READ:
            self._close(self.subscriptions.remove(name))
            self._control.touch().withdraw(name, Right.READ)

    def renew(self, topic: Topic) -> None:
        """Replace a topic's delegation and secrets, for what is published or read of it."""
        self.publications.renew(topic.name, topic.own_secrets, self._clock.now_s)
        subscription = self.subscriptions.get(topic.name)
        if subscription is not None:
            subscription.topic = topic
            for writer_proxy in subscription.all():
                writer_proxy.renew(topic.secrets)
        self._control.touch().renew(topic.name, topic.delegation.chain)

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        """Process received frames."""
        self._clock.advance(now.mono_s)
        reception = self._reception
        at, count = 0, len(arrivals)
        while at < count:
            if reception.under_way is not None:
                writer_proxy, subscription = reception.under_way
                taken = writer_proxy.receive_run(arrivals, at, now.mono_s)
                if taken:
                    reception.fed[writer_proxy] = subscription
                    at += taken
                    continue
            self._receive_one(arrivals[at], now)
            at += 1
        if reception.fed:
            reception.hand_out(now.mono_s)

    def _receive_one(self, arrival: ReceivedFrame, now: Timestamps) -> None:
        try:
            header = decode(arrival.frame)
            if header.kind in _FOR_WRITER_PROXIES:
                self._reception.receive(header, arrival, now.mono_s)
            elif header.kind in _FOR_US:
                self._receive_ours(header, arrival, now)
            elif header.kind >= CONTROL_FROM:
                statement = self._control.touch().receive_control(arrival, header, now)
                if statement is not None:
                    self._reception.hand_out(now.mono_s)  # it may close writer proxies
                    self._take_statement(statement, now)
            else:
                self._drops[DropReason.UNKNOWN_KIND] += 1
        except RemoteError as error:
            self._drops[error.reason] += 1
        except Exception as error:  # one frame must not end the node
            self.boundary.record(error)
            self._drops[DropReason.INTERNAL] += 1

    def _receive_ours(self, header: Header, arrival: ReceivedFrame, now: Timestamps) -> None:
        """Process a frame that is addressed to this participant, not to a name."""
        if header.destination != self.name:
            raise StatementError(DropReason.NOT_FOR_US)
        if header.kind == Kind.ACKNACK:
            self.publications.receive_acknack(header, arrival.frame, now.mono_s, arrival.waited_s)
        elif header.kind == Kind.INTRODUCTION:
            self.publications.receive_introduction(header, arrival.frame)
        else:
            self._control.touch()
            self.diagnostics.receive(header, arrival, now)

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        """Update the state of a port's link."""
        self._control.touch().port_changed(port, up, now)

    def handle_timer(self, now: Timestamps) -> None:
        """Process the timers that are due."""
        if self._control.has_changed or now.mono_s >= self._control.early_s:
            self._control.handle_timer(now)
        self.publications.handle_timer(now.mono_s)
        self._reception.handle_timer(now.mono_s)
        self.flush(now.mono_s)

    def flush(self, now_s: float) -> None:
        """Pass frames and reports that are ready to the switch."""
        switch, scheduler = self.attachment.switch, self._scheduler
        if now_s != self._clock.now_s:
            self._clock.advance(now_s)
        if switch is None:
            self._clock.deaf_s = now_s
            return
        if switch is not self._sent_by:
            self._sent_by, self._clock.deaf_s = switch, now_s
            self.publications.attachment_changed(now_s)
        if self._reception.reporting:
            self._reception.report(now_s)
        if scheduler.is_ready or scheduler.uncounted is not None or now_s >= scheduler.due_s:
            for frames in scheduler.poll_turn(now_s):
                self.attachment.send(frames)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        if self._control.has_changed:
            self._control.read_timers()
        due_s = self._control.due_s
        if self.attachment.switch is None:  # nothing can be sent: hellos alone are due
            return due_s
        publications, reading = self.publications, self._reception.timers
        writing, own_s = publications.timers, publications.reader_paths.due_s
        writing_s = writing.next_due() if writing.touched else writing.due_s
        reading_s = reading.next_due() if reading.touched else reading.due_s
        for each_s in (writing_s, reading_s, self._scheduler.due_s, publications.background_paths.due_s):
            own_s = each_s if each_s < own_s else own_s
        for requests in publications.holding:
            own_s = min(own_s, requests.get_timer())
        self.offload.urgent_s = own_s
        return own_s if due_s is None or own_s < due_s else due_s

    def count_arrivals(self, frames_from: Callable[[int], int]) -> None:
        """Learn how to count the frames that have come from a port."""
        self.attachment.hello_protocol.liveness.count_arrivals(frames_from)

    def poll_neighbours(self) -> Mapping[int, frozenset[bytes]]:
        """Return, once, the addresses of neighbours, former ones too, at each port where they have changed."""
        return self.attachment.hello_protocol.neighbours.poll_addresses()

    def frames_to_send(self, now_s: float) -> list[OutgoingFrames]:
        """Return, once, the frames to send; call again until it returns none.

        So the first frames of a large message are under way while the next ones are being sealed. The topics take
        turns; urgent ones go first each time.
        """
        attachment = self.attachment
        if self.publications.holding:
            self.publications.release_requests(now_s)
        if not attachment.outgoing and (self._scheduler.is_ready or self._reception.reporting):
            self.flush(now_s)
        frames, attachment.outgoing = attachment.outgoing, []
        return frames

    def frames_sent(self, now_s: float) -> None:
        """Note that the frames returned last are sent now: sealing them took time."""
        if self._scheduler.uncounted is not None:
            self._scheduler.count_sent()
        for paths in self.publications.all_paths:
            if paths.leaving:
                paths.frames_sent(now_s)

    def poll_messages(self) -> list[Message]:
        """Return, once, the messages that arrived, in order within each writer proxy."""
        messages, self._reception.messages = self._reception.messages, []
        return messages

    def leave(self) -> None:
        """Leave the overlay: close writer proxies, withdraw every name."""
        self._close(self.subscriptions.leave())
        self._control.touch().withdraw_all()

    def _check(self, topic: Topic, right: Right, *, is_free: bool) -> None:
        if right not in topic.delegation.rights or not topic.secrets:
            raise LocalError(f"no delegation to {right.value} {topic.name.short}")
        if not is_free:
            raise LocalError(f"{topic.name.short} is in use already: {right.value} is refused for it")

    def _join_service(
        self,
        topic: Topic,
        right: Right,
        description: bytes,
        *,
        is_global: bool = True,
        urgent: bool = False,
        paths: int = 1,
        options: SendOptions = DEFAULT_OPTIONS,
        is_session: bool = False,
    ) -> Publisher:
        is_free = topic.name not in self.publications and self.subscriptions.get(topic.name) is None
        self._check(topic, right, is_free=is_free)
        patience = CALLS if right is Right.CALL else TOPICS
        settings = PublisherSettings(urgent=urgent, patience=patience, paths=paths, options=options)
        publisher = self.publications.add(topic.name, topic.own_secrets, description, settings)
        self.publications.enable_unicast(topic.name, topic.own_secrets, settings)
        self.subscriptions.add(
            Subscription(topic=topic, right=right, since_s=self._clock.now_s, paths=paths, is_session=is_session)
        )
        self._control.touch().advertisement(
            topic.delegation.subject,
            right,
            topic.delegation.chain,
            is_global=is_global,
            paths=paths,
            is_session=is_session,
        )
        return publisher

    def _answer_ping(self, question: Question, _now: Timestamps) -> Mapping[str, object]:
        """Return the rights by which this node advertises a name."""
        ours = [each for each in self.attachment.advertisements if each.subject.name == question.name]
        return {"rights": [each.right.value for each in ours if each.right is not Right.ATTACH]}

    def _introduction(self) -> bytes:
        """Return the introduction of this incarnation; signed again if an earlier incarnation proves to be ahead."""
        started, source = self.attachment.started, self._source
        if self._introduced[0] != started:
            wire = Introduction.make(
                self._identity.subject, self._identity.key, source.incarnation, started, source.control_keys.public
            )
            self._introduced = started, wire
        return self._introduced[1]

    def _take_statement(self, statement: Statement, now: Timestamps) -> None:
        if statement.type is StatementType.JOIN:
            self.publications.receive_join(Join.from_fields(statement.fields), now.mono_s)
        elif statement.type is StatementType.JOIN_REFRESH:
            for join in self.attachment.refreshed_joins(statement):
                self.publications.receive_join(join, now.mono_s)
        elif statement.type is StatementType.REVOKE:
            revocation = self.attachment.receive_revocation(statement, now, self.subscriptions.has_issuer)
            if revocation is not None:
                self._close(self.subscriptions.recheck(revocation.fingerprint, now.unix_s))
        elif statement.type is StatementType.ANSWER:
            response = Response.from_fields(statement.fields)
            change = self.subscriptions.receive_response(response, now)
            self.subscriptions.note_cost(response)
            self._reception.messages += change.rest
            self._close(change.ended, goodbye=False)  # they may return to what waits for them
            self._reception.reporting.update(dict.fromkeys(change.opened))

    def _close(self, writer_proxies: list[WriterProxy], *, goodbye: bool = True) -> None:
        """Close writer proxies and the streams to ended peers; ``goodbye``: also send each publisher a goodbye."""
        self._reception.close(writer_proxies, goodbye=goodbye)
        for writer_proxy in writer_proxies:
            self.publications.forget(
                writer_proxy.topic, PeerIncarnation(writer_proxy.publisher, writer_proxy.incarnation)
            )
