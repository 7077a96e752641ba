"""Participant of the overlay: publishes, reads, serves and calls names; the core of a proxy.

Sans-I/O; an I/O layer or a simulated network passes it frames and time, and takes out frames and messages.

A sent message passes ``publish``, the Publisher (number, seal, cache) and the switch. A received DATA or HEARTBEAT
frame passes the writer proxy of its topic and source, and leaves by ``poll_messages``. A node that serves or calls a
name both publishes and reads it. A server's responses to one client, and a client's requests to one server, use unicast
streams.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final, TypedDict

from gdp.client.attachment import Attachment
from gdp.client.control_keys import ControlKeys
from gdp.client.identities import ReaderIdentity, WriterIdentity
from gdp.client.publications import Publications
from gdp.client.publisher import Publisher
from gdp.client.reader_proxies import CALLS, TOPICS, ReaderProxies
from gdp.client.request_streams import RequestStreams
from gdp.client.send_options import DEFAULT_OPTIONS, PublisherSettings, SendOptions
from gdp.client.subscription import Message, Subscription, Subscriptions, Topic
from gdp.client.timer_queue import TimerQueue
from gdp.client.unicast_stream import Party, PeerIncarnation
from gdp.client.writer_proxy import WriterProxy, WriterProxyState
from gdp.control.boundary import ErrorBoundary
from gdp.control.diagnostics import Diagnostics, Question
from gdp.control.join import Join
from gdp.control.query import Response
from gdp.control.settings import NodeSettings
from gdp.crypto.exchange import EXCHANGE_KEY_BYTES, ExchangeKey
from gdp.crypto.identity import Identity
from gdp.crypto.introduction import Introduction
from gdp.crypto.statements import Statement, StatementType
from gdp.errors import DropReason, LocalError, RemoteError, StatementError
from gdp.frame.codec import Header, decode
from gdp.frame.kinds import CONTROL_FROM, Kind
from gdp.intervals import NEIGHBOUR
from gdp.message.loss import Losses, LossReason
from gdp.names import Name
from gdp.sansio import OutgoingFrames, ReceivedFrame, Timestamps
from gdp.trust.domain import Policy
from gdp.trust.right import Right
from gdp.trust.verifier import AdvertisementVerifier

if TYPE_CHECKING:
    from typing_extensions import Unpack

_FOR_WRITER_PROXIES: Final = (int(Kind.DATA), int(Kind.HEARTBEAT), int(Kind.PARITY))
_DIAGNOSTICS: Final = (int(Kind.DIAGNOSTIC_REQUEST), int(Kind.DIAGNOSTIC_REPLY))
_NOTES: Final = (int(Kind.ACKNACK), int(Kind.INTRODUCTION))

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


class Participant:
    """Protocol core of one participant.

    ``advertise``, ``serve``, ``call`` and ``subscribe`` raise ``LocalError`` without a delegation or a secret for the
    name, or if the name is in use here.
    """

    def __init__(self, identity: Identity, policy: Policy, settings: NodeSettings) -> None:
        self._identity = identity
        self._verifier = AdvertisementVerifier(policy)
        control_keys = ControlKeys(ExchangeKey.from_random(settings.random_bytes(EXCHANGE_KEY_BYTES)))
        source = WriterIdentity(identity.name, settings.incarnation, identity.key, settings.random_bytes, control_keys)
        self._publications = Publications(source, self._party_of)
        self._scheduler = self._publications.scheduler
        self._writer_proxies_due = TimerQueue[WriterProxy]()
        self._reporting: dict[WriterProxy, None] = {}  # writer proxies whose report may be due
        self._introduced = (-1, b"")  # since when, and the introduction
        reader = ReaderIdentity(
            identity.name, settings.incarnation, control_keys, self._introduction
        )  # one, for all its writer proxies
        self._subscriptions = Subscriptions(reader, self._verifier)
        self._messages: list[Message] = []
        self._under_way: tuple[WriterProxy, Subscription] | None = None  # whose next fragment is expected
        self._sent_by: object = None  # the switch that carried the latest frames
        self._now_s = 0.0
        self._awake_s = 0.0  # since when this participant has been scheduled without a stall
        self.boundary = ErrorBoundary()
        self._drops: Counter[DropReason] = Counter()
        self._source = source
        self.attachment = Attachment(identity, policy, settings, control_keys.public)
        self.attachment.advertisement(identity.subject, Right.ATTACH, (), is_global=True)
        self.diagnostics = Diagnostics(
            identity, policy, self.attachment.fragmenter, settings.first_sequence,
            lambda frames, _to, _now: self.attachment.send(frames),
        )  # fmt: skip
        self.diagnostics.register("ping", self._answer_ping, for_foreign=True)
        self.diagnostics.evidence_of = self.attachment.evidence_of

    @property
    def name(self) -> Name:
        """Return the participant's name."""
        return self._identity.name

    @property
    def held_bytes(self) -> int:
        """Return how much memory unfinished messages hold."""
        return self._subscriptions.held_bytes

    def drops(self) -> Mapping[DropReason, int]:
        """Return what was dropped, by reason."""
        attachment = self.attachment
        total = self._drops + self._subscriptions.drops + attachment.drops + attachment.refusals
        total += self._publications.drops + self.diagnostics.drops
        for writer_proxy in self.writer_proxies():
            total += writer_proxy.drops
        return total

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Timestamps) -> None:
        """Begin to discover a switch on a port."""
        self.attachment.hello_protocol.add_port(index, mac, mtu, cost, now.mono_s)

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
        self._check(topic, Right.PUBLISH, is_free=topic.name not in self._publications)
        settings = PublisherSettings(reliable=reliable, depth=depth, urgent=urgent, paths=paths, options=options)
        publisher = self._publications.add(topic.name, topic.own_secrets, description, settings)
        self._advertisement(topic, Right.PUBLISH, is_global=is_global, paths=paths)
        return publisher

    def serve(self, topic: Topic, description: bytes, **options: Unpack[ServiceOptions]) -> Publisher:
        """Serve a name; return the stream that all its clients receive. ``respond`` sends to one of them."""
        return self._join_service(topic, Right.SERVE, description, **options)

    def call(self, topic: Topic, description: bytes, **options: Unpack[ServiceOptions]) -> Publisher:
        """Call a name from now on; return the stream of requests to all its servers. ``send_request`` sends to one.

        A request that is published while ``peers`` is empty reaches no server.
        """
        return self._join_service(topic, Right.CALL, description, **options)

    def respond(self, service: Name, client: Name, message: bytes) -> None:
        """Send a message to one client of a name that is served here.

        Raises:
            LocalError: that client is not connected (any more), or there are too many; or the message is above the
                limits.
        """
        self._tell(Right.SERVE, service, client, message)

    def send_request(self, service: Name, server: Name, message: bytes, call: Hashable = None) -> None:
        """Send a request to one server of a name that is called here, apart from the stream to all of them.

        Args:
            call: by which ``end_call`` cancels it; None: it does not.

        Raises:
            LocalError: that server is not connected (any more), or there are too many; or the message is above the
                limits.
        """
        if call is None:
            self._tell(Right.CALL, service, server, message)
        else:
            self._requests_of(service).send_to(call, server, message, self._now_s)

    def send_requests(self, service: Name, message: bytes, call: Hashable) -> None:
        """Send a request to all servers of a name that is called here; the path to the fastest governs.

        Raises:
            LocalError: the message is above the limits.
        """
        self._requests_of(service).send_to_all(call, message, self._now_s)

    def end_call(self, service: Name, call: Hashable) -> None:
        """Cancel what has not left of a call's requests, and their repairs; those of a withdrawn name have ended."""
        requests = self._publications.requests(service)
        if requests is not None:
            requests.cancel(call)

    def is_acknowledged(self, name: Name) -> bool:
        """Return whether readers have confirmed all that was sent on a name; ``withdraw`` drops the rest."""
        return self._publications.is_acknowledged(name)

    def unacknowledged(self, name: Name) -> int:
        """Return how many messages on a name are not confirmed."""
        return self._publications.unacknowledged(name)

    def peers(self, service: Name) -> list[Name]:
        """Return the servers of a name called here, or the clients of one served here, that are connected and keep up.

        A server that falls behind the others, or is silent for ``SERVER.lease_s``, is excluded until it confirms again.
        """
        publisher = self._publications.get(service)
        if publisher is None:
            return []
        return [
            party
            for party in self.connected_peers(service)
            if publisher.is_followed_by(party, self._now_s, self._awake_s)
        ]

    def connected_peers(self, service: Name) -> list[Name]:
        """Return all connected peers, those that do not keep up included; ``peers`` returns a subset."""
        return self._peers(service, ReaderProxies.is_read_by)

    def silent_peers(self, service: Name) -> list[Name]:
        """Return the peers that have stopped reporting and may return, such as those behind a dead access point."""
        return self._peers(service, ReaderProxies.is_suspended)

    def _peers(self, service: Name, fits: Callable[[ReaderProxies, Name], bool]) -> list[Name]:
        """Return the peers with a live writer proxy whose state as readers of the service's publisher fits."""
        publisher = self._publications.get(service)
        if publisher is None:
            return []
        return [
            writer_proxy.publisher
            for writer_proxy in self.writer_proxies_of(service)
            if writer_proxy.state is WriterProxyState.LIVE and fits(publisher.matched, writer_proxy.publisher)
        ]

    def withdraw(self, name: Name) -> None:
        """Stop publishing, serving or calling a name; an unused name is ignored.

        The name may be used again at any time, also in another way.
        """
        if not self._publications.remove(name):
            return
        subscription = self._subscriptions.get(name)
        right = Right.PUBLISH
        if subscription is not None and subscription.right is not Right.READ:
            right = subscription.right
            self._close(self._subscriptions.remove(name))
        self.attachment.withdraw(name, right)

    def subscribe(self, topic: Topic, *, paths: int = 1) -> None:
        """Read a topic from now on, from every publisher of it; ``paths`` 2: by two paths from those that want two."""
        self._check(topic, Right.READ, is_free=self._subscriptions.get(topic.name) is None)
        self._subscriptions.add(topic, Right.READ, self._now_s, paths)
        self._advertisement(topic, Right.READ, is_global=False, paths=paths)

    def unsubscribe(self, name: Name) -> None:
        """Stop reading a topic; one that is not read is ignored. A later ``subscribe`` begins with new messages."""
        subscription = self._subscriptions.get(name)
        if subscription is not None and subscription.right is Right.READ:
            self._close(self._subscriptions.remove(name))
            self.attachment.withdraw(name, Right.READ)

    def renew(self, topic: Topic) -> None:
        """Replace a topic's delegation and secrets, for what is published or read of it."""
        self._publications.renew(topic.name, topic.own_secrets, self._now_s)
        subscription = self._subscriptions.get(topic.name)
        if subscription is not None:
            subscription.topic = topic
            for writer_proxy in subscription.all():
                writer_proxy.renew(topic.secrets)
        self.attachment.renew(topic.name, topic.delegation.chain)

    def subscribed(self) -> list[Topic]:
        """Return the topics that are read."""
        return [subscription.topic for subscription in self._subscriptions if subscription.right is Right.READ]

    def subscriptions(self) -> Iterator[tuple[Name, Right]]:
        """Yield the names that are read, served or called here, and the right for each."""
        for subscription in self._subscriptions:
            yield subscription.topic.name, subscription.right

    def publishers(self) -> list[Publisher]:
        """Return the publishers, one for each published topic."""
        return list(self._publications)

    def writer_proxies(self) -> Iterator[WriterProxy]:
        """Yield the writer proxies: one for each publisher of each topic, and those of unicast streams."""
        for subscription in self._subscriptions:
            yield from subscription.all()

    def writer_proxies_of(self, topic: Name) -> list[WriterProxy]:
        """Return the writer proxies of one topic, without unicast streams."""
        subscription = self._subscriptions.get(topic)
        return [] if subscription is None else list(subscription.writer_proxies.values())

    def absent_writers(self, name: Name) -> int:
        """Return how many publishers of a topic that is read have lost their route, and may return."""
        subscription = self._subscriptions.get(name)
        return 0 if subscription is None else len(subscription.absent)

    def losses_of(self, name: Name) -> Losses:
        """Return what was lost of a name's messages since it was subscribed."""
        subscription = self._subscriptions.get(name)
        return Losses() if subscription is None else subscription.losses()

    def lost(self) -> Mapping[LossReason, int]:
        """Return how many messages to this participant were lost, by reason."""
        return self._subscriptions.lost()

    def unconfirmed(self) -> Mapping[LossReason, int]:
        """Return how many messages of this participant some reader did not get, as far as known here, by reason."""
        return self._publications.unconfirmed()

    def receive(self, arrivals: Sequence[ReceivedFrame], now: Timestamps) -> None:
        """Process received frames."""
        self._look_at_clock(now.mono_s)
        fed: dict[WriterProxy, Subscription] = {}
        at = 0
        while at < len(arrivals):
            if self._under_way is not None:
                writer_proxy, subscription = self._under_way
                taken = writer_proxy.receive_run(arrivals, at, now.mono_s)
                if taken:
                    fed[writer_proxy] = subscription
                    at += taken
                    continue
            self._receive_one(arrivals[at], now, fed)
            at += 1
        self._hand_out(fed, now.mono_s)

    def _hand_out(self, fed: dict[WriterProxy, Subscription], now_s: float) -> None:
        for writer_proxy, subscription in fed.items():
            self._messages += subscription.poll_messages(writer_proxy.publisher)
            if writer_proxy.is_report_due(now_s):
                self._reporting[writer_proxy] = None  # it states for how long it held back what it reports
            self._writer_proxies_due.reschedule(writer_proxy)
        fed.clear()

    def _receive_one(self, arrival: ReceivedFrame, now: Timestamps, fed: dict[WriterProxy, Subscription]) -> None:
        try:
            header = decode(arrival.frame)
            if header.kind in _FOR_WRITER_PROXIES:
                self._writer_proxy(header, arrival, now.mono_s, fed)
            elif header.kind in _NOTES:
                self._take_note(header, arrival, now.mono_s)
            elif header.kind in _DIAGNOSTICS:
                self._take_diagnostic(header, arrival, now)
            elif header.kind >= CONTROL_FROM:
                statement = self.attachment.receive_control(arrival, header, now)
                if statement is not None:
                    self._hand_out(fed, now.mono_s)  # it may close writer proxies
                    self._take_statement(statement, now)
            else:
                self._drops[DropReason.UNKNOWN_KIND] += 1
        except RemoteError as error:
            self._drops[error.reason] += 1
        except Exception as error:  # one frame must not end the node
            self.boundary.record(error)
            self._drops[DropReason.INTERNAL] += 1

    def port_changed(self, port: int, up: bool, now: Timestamps) -> None:
        """Update the state of a port's link."""
        self.attachment.port_changed(port, up, now)

    def handle_timer(self, now: Timestamps) -> None:
        """Process the timers that are due."""
        self.attachment.handle_timer(now)
        self.diagnostics.handle_timer(now)
        self._look_at_clock(now.mono_s)
        self._publications.handle_timer(now.mono_s)
        for writer_proxy in self._writer_proxies_due.poll_due(now.mono_s):
            writer_proxy.handle_timer(now.mono_s)
            self._reporting[writer_proxy] = None
            subscription = self._subscriptions.get(writer_proxy.topic)
            if subscription is not None:  # it may have gone on without what is lost
                self._messages += subscription.poll_messages(writer_proxy.publisher)
        self.flush(now.mono_s)

    def flush(self, now_s: float) -> None:
        """Pass frames and reports that are ready to the switch."""
        if self.attachment.switch is None:
            return
        self._look_at_clock(now_s)
        if self.attachment.switch != self._sent_by:
            self._sent_by = self.attachment.switch
            self._publications.attachment_changed(now_s)
        for writer_proxy in self._reporting:
            self._report(writer_proxy, now_s)
        self._reporting.clear()
        for frames in self._scheduler.poll_turn(now_s):
            self.attachment.send(frames)

    def _report(self, writer_proxy: WriterProxy, now_s: float) -> None:
        notes = writer_proxy.control_to_send(now_s)
        if notes:
            self.attachment.send(notes)
        self._writer_proxies_due.reschedule(writer_proxy)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [self.attachment.get_timer(), self.diagnostics.get_timer()]
        if self.attachment.switch is not None:  # without a switch nothing can be sent: hellos alone are due
            times += [self._publications.next_due(), self._writer_proxies_due.next_due()]
        return min((time for time in times if time is not None), default=None)

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
        out = self.attachment.frames_to_send()
        self._publications.release_requests(now_s)
        if not out and (self._scheduler or self._reporting):
            self.flush(now_s)
            out = self.attachment.frames_to_send()
        return out

    def frames_sent(self, now_s: float) -> None:
        """Note that the frames returned last are sent now: sealing them took time."""
        self._publications.frames_sent(now_s)

    def poll_messages(self) -> list[Message]:
        """Return, once, the messages that arrived, in order within each writer proxy."""
        messages, self._messages = self._messages, []
        return messages

    def leave(self) -> None:
        """Leave the overlay: close writer proxies, withdraw every name."""
        self._close(self._subscriptions.leave())
        self.attachment.withdraw_all()

    def _check(self, topic: Topic, right: Right, *, is_free: bool) -> None:
        if right not in topic.delegation.rights or not topic.secrets:
            raise LocalError(f"no delegation to {right.value} {topic.name.short}")
        if not is_free:
            raise LocalError(f"{topic.name.short} is in use already: {right.value} is refused for it")

    def _advertisement(
        self, topic: Topic, right: Right, *, is_global: bool, paths: int, is_session: bool = False
    ) -> None:
        delegation = topic.delegation
        self.attachment.advertisement(
            delegation.subject, right, delegation.chain, is_global=is_global, paths=paths, is_session=is_session
        )

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
        is_free = topic.name not in self._publications and self._subscriptions.get(topic.name) is None
        self._check(topic, right, is_free=is_free)
        patience = CALLS if right is Right.CALL else TOPICS
        settings = PublisherSettings(urgent=urgent, patience=patience, paths=paths, options=options)
        publisher = self._publications.add(topic.name, topic.own_secrets, description, settings)
        self._publications.enable_unicast(topic.name, topic.own_secrets, settings)
        self._subscriptions.add(topic, right, self._now_s, paths, is_session=is_session)
        self._advertisement(topic, right, is_global=is_global, paths=paths, is_session=is_session)
        return publisher

    def _look_at_clock(self, now_s: float) -> None:
        if now_s - self._now_s > 2 * NEIGHBOUR.refresh_s:  # although hellos are due: it was not scheduled
            self._awake_s = now_s  # frames that the peers sent meanwhile are still to be processed
        self._now_s = now_s

    def _requests_of(self, service: Name) -> RequestStreams:
        requests = self._publications.requests(service)
        if requests is None:
            raise LocalError(f"no call of {service.short} here")
        return requests

    def _tell(self, right: Right, service: Name, party: Name, message: bytes) -> None:
        subscription = self._subscriptions.get(service)
        if subscription is None or subscription.right is not right:
            raise LocalError(f"no {right.value} of {service.short} here")
        self._publications.send_to(service, party, message, self._now_s)

    def _writer_proxy(
        self, header: Header, arrival: ReceivedFrame, now_s: float, fed: dict[WriterProxy, Subscription]
    ) -> None:
        """Pass a frame to its writer proxy, and add that to ``fed``."""
        found = self._subscriptions.find(header, now_s)
        if found is None:
            self._drops[DropReason.NOT_FOR_US] += 1
            return
        subscription, writer_proxy = found
        writer_proxy.receive(header, arrival.frame, now_s, arrival.waited_s)
        fed[writer_proxy] = subscription
        if header.parts > 1:
            self._under_way = writer_proxy, subscription

    def _take_diagnostic(self, header: Header, arrival: ReceivedFrame, now: Timestamps) -> None:
        if header.destination != self.name:
            raise StatementError(DropReason.NOT_FOR_US)
        self.diagnostics.receive(header, arrival, now)

    def _answer_ping(self, question: Question, _now: Timestamps) -> Mapping[str, object]:
        """Return the rights by which this node advertises a name."""
        ours = [each for each in self.attachment.advertisements if each.subject.name == question.name]
        return {"rights": [each.right.value for each in ours if each.right is not Right.ATTACH]}

    def _take_note(self, header: Header, arrival: ReceivedFrame, now_s: float) -> None:
        if header.destination != self.name:
            raise StatementError(DropReason.NOT_FOR_US)
        if header.kind == Kind.INTRODUCTION:
            self._publications.receive_introduction(header, arrival.frame)
        else:
            self._publications.receive_acknack(header, arrival.frame, now_s, arrival.waited_s)

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
            self._publications.receive_join(Join.from_fields(statement.fields), now.mono_s)
        elif statement.type is StatementType.JOIN_REFRESH:
            for join in self.attachment.refreshed_joins(statement):
                self._publications.receive_join(join, now.mono_s)
        elif statement.type is StatementType.REVOKE:
            self._revoke(statement, now)
        elif statement.type is StatementType.ANSWER:
            change = self._subscriptions.receive_response(Response.from_fields(statement.fields), now)
            self._messages += change.rest
            self._close(change.ended, goodbye=False)  # they may return to what waits for them
            self._reporting.update(dict.fromkeys(change.opened))

    def _party_of(self, service: Name, party: bytes) -> Party | None:
        """Return another party of a service that is connected now."""
        subscription = self._subscriptions.get(service)
        writer_proxy = None if subscription is None else subscription.writer_proxies.get(party)  # type: ignore[call-overload]
        if subscription is None or writer_proxy is None:
            return None
        return Party(
            PeerIncarnation(writer_proxy.publisher, writer_proxy.incarnation),
            writer_proxy.exchange,
            writer_proxy.second_path_s,
            subscription.has_session(writer_proxy),
        )

    def _revoke(self, statement: Statement, now: Timestamps) -> None:
        """Close the writer proxies of publishers whose advertisement depends on a revoked certificate."""
        revocation = self.attachment.receive_revocation(statement, now, self._holds)
        if revocation is not None:
            self._close(self._subscriptions.recheck(revocation.fingerprint, now.unix_s))

    def _holds(self, issuer_key: bytes) -> bool:
        """Return whether a certificate of this key is held here: in our own delegations, or in those of our peers."""
        is_own = any(
            issuer_key == pending_advertisement.subject.owner_key
            for pending_advertisement in self.attachment.advertisements
        )
        return is_own or self._subscriptions.has_issuer(issuer_key)

    def _close(self, writer_proxies: list[WriterProxy], *, goodbye: bool = True) -> None:
        """Close writer proxies and the streams to ended peers; ``goodbye``: also send each publisher a goodbye."""
        self._under_way = None
        for writer_proxy in writer_proxies:
            notes = writer_proxy.close()
            if goodbye:
                self.attachment.send(notes)
            self._reporting.pop(writer_proxy, None)
            self._writer_proxies_due.reschedule(writer_proxy)
            self._publications.forget(
                writer_proxy.topic, PeerIncarnation(writer_proxy.publisher, writer_proxy.incarnation)
            )
