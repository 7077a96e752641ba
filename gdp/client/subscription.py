"""Subscriptions of a participant: the names that it reads, with a writer proxy for each accepted advertiser.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).

This module decides which peers are accepted. The switch forwards an advertisement, and this participant verifies it
itself. A reader accepts publishers, a server accepts callers, a client accepts servers. A server's responses to one
client, and a client's requests to one server, use a second writer proxy of the same party. It is created with its first
frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from gdp.client.delivery import NOT_BEGUN, Delivered, Ended
from gdp.client.identities import PublisherIdentity, ReaderIdentity
from gdp.client.key_epochs import Secrets
from gdp.client.unicast_stream import Party, PeerIncarnation, UnicastReceiver, private_incarnation, private_name
from gdp.client.writer_proxy import WriterProxy, WriterProxyState
from gdp.control.rib_statements import Response
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import Header
from gdp.intervals import SERVER
from gdp.message.loss import Losses, LossReason, LostRange
from gdp.message.reassembly import VerifiesDigest
from gdp.names import Name
from gdp.sansio import Timestamps, new_tuple
from gdp.trust.advertisement import Advertisement
from gdp.trust.delegation import Delegation
from gdp.trust.lru import Lru
from gdp.trust.right import HEARS, Right
from gdp.trust.verifier import AdvertisementVerifier

ENDED_MAX: Final = 4_096  # closed writer proxies whose end is remembered
ABSENT_MAX: Final = 1_024  # publishers of one topic that went, and may return


class Message(NamedTuple):
    """A message that arrived, and its publisher's description of the topic's messages.

    ``private``: a server's response, or a client's request to one server; for this participant alone.
    """

    topic: Name
    delivered: Delivered
    description: bytes
    private: bool = False


@dataclass(frozen=True, slots=True)
class Topic:
    """A name with this participant's rights on it, and the topic's secrets by epoch.

    ``sealing``: of the epochs that may seal; None: all.
    """

    delegation: Delegation
    secrets: Secrets
    sealing: Secrets | None = None

    @property
    def name(self) -> Name:
        """Return the topic's name."""
        return self.delegation.name

    @property
    def own_secrets(self) -> Secrets:
        """Return the secrets under which this participant seals; the newest does."""
        return self.secrets if self.sealing is None else self.sealing


@dataclass(slots=True, kw_only=True)
class Subscription:
    """One name that is read, the right of its peers, and its writer proxies.

    Attributes:
        paths: over how many paths frames come, and reports go, where the peer wants the same.
        is_session: a session secret authenticates the unicast streams of this name, where the peer wants the same.
        head_bytes: of each message, delivered apart, so that the rest need not be copied; a bundled message is whole.
        private: by writer.
        absent: publishers whose route has ended, with their incarnation, and where their writer proxies ended.
        past_losses: of closed writer proxies.
        since_s: when it began, monotonic.
    """

    topic: Topic
    right: Right
    since_s: float
    paths: int = 1
    is_session: bool = False
    head_bytes: int = 0
    writer_proxies: dict[Name, WriterProxy] = field(default_factory=dict)
    private: dict[Name, UnicastReceiver] = field(default_factory=dict)
    absent: dict[Name, tuple[int, Ended]] = field(default_factory=dict)
    past_losses: Losses = field(default_factory=Losses)

    def losses(self) -> Losses:
        """Return what was lost of everything that is read on this name."""
        losses = Losses()
        losses.update(self.past_losses)
        for writer_proxy in self.all():
            losses.update(writer_proxy.losses)
        return losses

    def forget_absent(self, party: Name, why: LossReason) -> None:
        """Forget an incarnation of an absent publisher; its messages that are known to be missing count as lost."""
        _, ended = self.absent.pop(party)
        if ended.sequence < ended.known:
            self.past_losses.add(LostRange(ended.sequence, ended.known - 1, why))

    def all(self) -> list[WriterProxy]:
        """Return every writer proxy."""
        return [*self.writer_proxies.values(), *self.private.values()]

    def has_session(self, writer_proxy: WriterProxy) -> bool:
        """Return whether a session secret authenticates the unicast streams with a peer: both ends ask for it."""
        advertisement = writer_proxy.advertisement
        return self.is_session and advertisement is not None and advertisement.is_session

    def set_advertisement(self, writer_proxy: WriterProxy, advertisement: Advertisement) -> None:
        """Set the newest advertisement of a publisher: it may want two paths, or no longer."""
        writer_proxy.advertisement_sequence, writer_proxy.advertisement = advertisement.sequence, advertisement
        writer_proxy.paths = advertisement.paths if self.paths > 1 else 1
        private = self.private.get(writer_proxy.publisher)
        if private is not None:
            private.paths = writer_proxy.paths

    def poll_messages(self, source: Name) -> list[Message]:
        """Return, once, the messages of one source; unicast ones only once the source has sent their description."""
        messages = list[Message]()
        if source not in self.writer_proxies:
            return messages
        writer_proxy = self.writer_proxies[source]
        topic, description = writer_proxy.topic, writer_proxy.description
        if writer_proxy.delivery.ready:
            for each in writer_proxy.delivery.poll():
                messages.append(new_tuple(Message, (topic, each, description, False)))
        private = self.private.get(source) if self.private else None
        if private is not None and private.delivery.ready and writer_proxy.state is WriterProxyState.LIVE:
            for each in private.delivery.poll():
                messages.append(new_tuple(Message, (topic, each, description, True)))
        return messages


class _UnicastRoute(NamedTuple):
    """Route by which a party may send to us alone; ``verifier`` None: under a session secret."""

    subscription: Subscription
    writer: Name
    stream: Name
    verifier: VerifiesDigest | None


class StreamChanges(NamedTuple):
    """Writer proxies that began; those to close, which get no further frames; and the last messages of these."""

    opened: list[WriterProxy]
    ended: list[WriterProxy]
    rest: list[Message]


class Subscriptions:
    """All subscriptions of one participant."""

    def __init__(self, reader: ReaderIdentity, verifier: AdvertisementVerifier) -> None:
        self._reader = reader
        self._verifier = verifier
        self._by_name: dict[Name, Subscription] = {}
        self._routes: dict[tuple[bytes, int], _UnicastRoute] = {}  # by writer and incarnation, as in frame headers
        self._ended: Lru[Ended] = Lru(ENDED_MAX)
        self.drops: Counter[DropReason] = Counter()  # of closed writer proxies, of advertisements, and by who reads
        self._past_losses: Counter[LossReason] = Counter()  # on names that are no longer read

    def __iter__(self) -> Iterator[Subscription]:
        return iter(self._by_name.values())

    @property
    def held_bytes(self) -> int:
        """Return how much memory unfinished messages hold."""
        return self._reader.budget.held_bytes

    def lost(self) -> Counter[LossReason]:
        """Return how many messages were lost, by reason."""
        return sum((each.losses().counts for each in list(self._by_name.values())), self._past_losses)

    def get(self, name: Name) -> Subscription | None:
        """Return the subscription of a name, or None."""
        return self._by_name.get(name)

    def writer_proxies(self) -> Iterator[WriterProxy]:
        """Yield the writer proxies: one for each publisher of each topic, and those of unicast streams."""
        for subscription in self:
            yield from subscription.all()

    def writer_proxies_of(self, topic: Name) -> list[WriterProxy]:
        """Return the writer proxies of one topic, without unicast streams."""
        subscription = self._by_name.get(topic)
        return [] if subscription is None else list(subscription.writer_proxies.values())

    def losses_of(self, name: Name) -> Losses:
        """Return what was lost of a name's messages since it was subscribed."""
        subscription = self._by_name.get(name)
        return Losses() if subscription is None else subscription.losses()

    def party_of(self, service: Name, party: bytes) -> Party | None:
        """Return another party of a service that is connected now."""
        subscription = self._by_name.get(service)
        writer_proxy = None if subscription is None else subscription.writer_proxies.get(party)  # type: ignore[call-overload]
        if subscription is None or writer_proxy is None:
            return None
        incarnation_id = PeerIncarnation(writer_proxy.publisher, writer_proxy.incarnation)
        is_session = subscription.has_session(writer_proxy)
        return Party(incarnation_id, writer_proxy.exchange, writer_proxy.second_path_s, is_session)

    def add(self, subscription: Subscription) -> None:
        """Read a name from now on."""
        self._by_name[subscription.topic.name] = subscription

    def remove(self, name: Name) -> list[WriterProxy]:
        """Stop reading a name; return the writer proxies to close."""
        subscription = self._by_name.pop(name, None)
        if subscription is None:
            return []
        ended = self._end_all(subscription)
        self._past_losses += subscription.losses().counts
        return ended

    def find(self, header: Header, now_s: float) -> tuple[Subscription, WriterProxy] | None:
        """Return the subscription and writer proxy of a frame, or None."""
        subscription = self._by_name.get(header.destination)  # type: ignore[call-overload]
        if subscription is not None:
            writer_proxy = subscription.writer_proxies.get(header.source)
            return None if writer_proxy is None else (subscription, writer_proxy)
        if header.destination != self._reader.name:
            return None
        route = self._routes.get((header.source, header.incarnation))
        return None if route is None else (route.subscription, self._private_writer_proxy(route, now_s))

    def receive_response(self, response: Response, now: Timestamps) -> StreamChanges:
        """Process a switch's response about a party: its advertisement, or its end.

        Raises:
            StatementError: the advertisement is invalid or about something else, or the end is of an older one.
        """
        subscription, change = self._by_name.get(response.name), StreamChanges([], [], [])
        if subscription is None or response.advertiser == self._reader.name:
            return change
        writer_proxy = subscription.writer_proxies.get(response.advertiser)
        if not response.advertisement:
            if writer_proxy is not None and writer_proxy.advertisement_sequence > response.sequence:
                raise StatementError(DropReason.STALE, "gone, of an earlier advertisement")
            return change._replace(ended=self._detach(subscription, response.advertiser)) if writer_proxy else change
        advertisement = self._verifier.verify(response.advertisement, now.unix_s)
        is_heard = HEARS[subscription.right] is advertisement.right
        if not is_heard or advertisement.name != response.name or advertisement.node != response.advertiser:
            raise StatementError(DropReason.WRONG_NAME, "an advertisement about something else")
        self._reader.control_keys.shared(advertisement.exchange)  # or it is refused before anything changes
        if writer_proxy is not None:
            if advertisement.sequence <= writer_proxy.advertisement_sequence:
                return change
            known, is_restarted = writer_proxy.advertisement, writer_proxy.incarnation != advertisement.incarnation
            if not is_restarted and known is not None and known.is_session == advertisement.is_session:
                subscription.set_advertisement(writer_proxy, advertisement)
                return change
            if is_restarted:
                writer_proxy.delivery.finish()
            rest = [Message(response.name, each, writer_proxy.description) for each in writer_proxy.delivery.poll()]
            change = StreamChanges([], self._detach(subscription, advertisement.node), rest)
        return change._replace(opened=self._open(subscription, advertisement, now.mono_s))

    def note_cost(self, response: Response) -> None:
        """Note the cost of the path to a party, if an accepted response states it."""
        subscription = self._by_name.get(response.name)
        writer_proxy = None if subscription is None else subscription.writer_proxies.get(response.advertiser)
        if writer_proxy is not None and response.cost is not None:
            writer_proxy.cost = response.cost

    def has_issuer(self, key: bytes) -> bool:
        """Return whether an accepted advertisement depends on a certificate that this key, 33 bytes, issued."""
        advertisements = (each.advertisement for subscription in self for each in subscription.writer_proxies.values())
        return any(each is not None and key in each.issuers for each in advertisements)

    def recheck(self, fingerprint: bytes, unix_s: float) -> list[WriterProxy]:
        """Return the writer proxies to close, because their party's advertisement depended on what was revoked."""
        ended: list[WriterProxy] = []
        for subscription in self._by_name.values():
            for writer_proxy in list(subscription.writer_proxies.values()):
                if writer_proxy.advertisement is None or fingerprint not in writer_proxy.advertisement.fingerprints:
                    continue
                try:
                    self._verifier.recheck(writer_proxy.advertisement, unix_s)
                except StatementError as error:
                    self.drops[error.reason] += 1
                    ended += self._detach(subscription, writer_proxy.publisher)
        return ended

    def leave(self) -> list[WriterProxy]:
        """Return all writer proxies, for the caller to close."""
        return [writer_proxy for subscription in self._by_name.values() for writer_proxy in self._end_all(subscription)]

    def _open(self, subscription: Subscription, advertisement: Advertisement, now_s: float) -> list[WriterProxy]:
        topic, party = subscription.topic, advertisement.node
        ended = self._ended.get(topic.name + _key(party, advertisement.incarnation)) or NOT_BEGUN
        incarnation_id, before = subscription.absent.get(party, (advertisement.incarnation, ended))
        if incarnation_id == advertisement.incarnation:
            ended = before
            subscription.absent.pop(party, None)
        else:
            subscription.forget_absent(party, LossReason.PUBLISHER_RESTARTED)
        writer_proxy = WriterProxy(
            topic=topic.name,
            reader=self._reader,
            publisher=PublisherIdentity(
                party, advertisement.incarnation, advertisement.member.key, advertisement.exchange
            ),
            secrets=topic.secrets,
            now_s=now_s,
            before=ended._replace(is_restarted=incarnation_id != advertisement.incarnation),
            waits_since_s=subscription.since_s,
        )
        writer_proxy.set_head(subscription.head_bytes)
        subscription.writer_proxies[party] = writer_proxy
        subscription.set_advertisement(writer_proxy, advertisement)
        if subscription.right is Right.SERVE:
            writer_proxy.schedule.idle_s = SERVER.refresh_s
        if subscription.right is not Right.READ:
            stream = self._stream_from(subscription, writer_proxy)
            verifier = None if subscription.has_session(writer_proxy) else advertisement.member.key
            self._routes[party, private_incarnation(stream)] = _UnicastRoute(subscription, party, stream, verifier)
        return [writer_proxy]

    def _private_writer_proxy(self, route: _UnicastRoute, now_s: float) -> UnicastReceiver:
        """Return the receiver of a party's unicast stream to us."""
        subscription, writer = route.subscription, route.writer
        writer_proxy = subscription.private.get(writer)
        if writer_proxy is None:
            public, ended = subscription.writer_proxies[writer], self._ended.get(route.stream) or NOT_BEGUN
            writer_proxy = subscription.private[writer] = UnicastReceiver(
                name=route.stream,
                reader=self._reader,
                public=public,
                verifier=route.verifier,
                secrets=subscription.topic.secrets,
                now_s=now_s,
                before=ended,
            )
            writer_proxy.paths = public.paths
        return writer_proxy

    def _stream_from(self, subscription: Subscription, writer_proxy: WriterProxy) -> Name:
        """Return the name of the stream by which a writer proxy's publisher sends to us alone."""
        writer = PeerIncarnation(writer_proxy.publisher, writer_proxy.incarnation)
        reader = PeerIncarnation(self._reader.name, self._reader.incarnation)
        is_session = subscription.has_session(writer_proxy)
        return private_name(subscription.topic.name, writer, reader, is_session=is_session)

    def _end_all(self, subscription: Subscription) -> list[WriterProxy]:
        for party in list(subscription.absent):
            subscription.forget_absent(party, LossReason.DETACHED)
        return [
            writer_proxy
            for party in list(subscription.writer_proxies)
            for writer_proxy in self._end(subscription, party)
        ]

    def _detach(self, subscription: Subscription, party: Name) -> list[WriterProxy]:
        """End the writer proxies of a party that may return, in this incarnation or another."""
        writer_proxy = subscription.writer_proxies[party]
        if writer_proxy.ended.sequence:
            subscription.absent[party] = writer_proxy.incarnation, writer_proxy.ended._replace(resumes=True)
        if len(subscription.absent) > ABSENT_MAX:
            subscription.forget_absent(next(iter(subscription.absent)), LossReason.DETACHED)
        return self._end(subscription, party)

    def _end(self, subscription: Subscription, party: Name) -> list[WriterProxy]:
        writer_proxy = subscription.writer_proxies.pop(party)
        subscription.past_losses.update(writer_proxy.losses)
        self._remember(subscription.topic.name + _key(party, writer_proxy.incarnation), writer_proxy)
        self._routes.pop((party, private_incarnation(self._stream_from(subscription, writer_proxy))), None)
        private = subscription.private.pop(party, None)
        if private is None:
            return [writer_proxy]
        subscription.past_losses.update(private.losses)
        self._remember(private.topic, private)
        return [writer_proxy, private]

    def _remember(self, key: bytes, writer_proxy: WriterProxy) -> None:
        self._ended.put(key, writer_proxy.ended)
        self.drops += writer_proxy.drops


def _key(name: Name, incarnation: int) -> bytes:
    return name + incarnation.to_bytes(8, "big")
