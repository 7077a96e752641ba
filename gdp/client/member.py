"""A member of the overlay that publishes and reads topics: what a proxy, a replica or a capsule is to the network.

Place: pure; a shell or a simulated network feeds it frames and time, and takes out frames and messages.

The walk of a message out: ``publish`` -> Publisher (number, seal, keep) -> the switch. And in: DATA or STATUS -> the
feed of its topic and source -> ``take_messages``. Whose word counts as a publisher's is decided here, by the claim that
the switch hands on and this member verifies itself.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from gdp.client.attachment import Attachment
from gdp.client.feed import Delivered, Feed, Reader
from gdp.client.publisher import Publisher, Secrets, Source
from gdp.control.join import Join
from gdp.control.query import Answer
from gdp.control.settings import NodeSettings
from gdp.crypto.identity import Identity
from gdp.crypto.note import topic_of
from gdp.crypto.statements import Statement, StatementType
from gdp.effects import Arrival, Instant, Transmit
from gdp.errors import DropReason, LocalError, RemoteError, StatementError
from gdp.frame.codec import Header, decode
from gdp.frame.kinds import CONTROL_FROM, Kind
from gdp.message.memory import Budget
from gdp.names import Name
from gdp.trust.delegation import Delegation
from gdp.trust.domain import Policy
from gdp.trust.right import Right
from gdp.trust.verifier import ClaimVerifier

_FOR_FEEDS: Final = (int(Kind.DATA), int(Kind.STATUS))
BYTES_AT_ONCE: Final = 96 << 10  # of what is not urgent, before anything else has its turn
BYTES_BESIDE_URGENT: Final = 64 << 10  # ... where there is an urgent topic: it may have to wait for so much

__all__ = ["Member", "Message", "Topic"]


class Message(NamedTuple):
    """A message that arrived, and what its publisher says the topic's messages are."""

    topic: Name
    delivered: Delivered
    description: bytes


@dataclass(frozen=True, slots=True)
class Topic:
    """A name with what this member may do with it, and the topic's secrets by epoch."""

    delegation: Delegation
    secrets: Secrets

    @property
    def name(self) -> Name:
        """Return the topic's name."""
        return self.delegation.name


@dataclass(slots=True)
class _Subscription:
    topic: Topic
    feeds: dict[Name, Feed] = field(default_factory=dict)


class Member:
    """The machine of one member."""

    def __init__(self, identity: Identity, policy: Policy, settings: NodeSettings) -> None:
        self._identity = identity
        self._incarnation = settings.incarnation
        self._reader = Reader(identity.name, settings.incarnation)  # one: its feeds share the numbers of their notes
        self._verifier = ClaimVerifier(policy)
        self._budget = Budget()
        self._publishers: dict[Name, Publisher] = {}
        self._urgent: list[Publisher] = []
        self._ordinary = deque[Publisher]()  # the one whose turn it is comes first
        self._subscriptions: dict[Name, _Subscription] = {}
        self._messages: list[Message] = []
        self._under_way: tuple[Feed, Name] | None = None  # whose next part is expected
        self._now_s = 0.0
        self._may_send = True  # a look at what publishers and feeds have ready may be worth it
        self._drops: Counter[DropReason] = Counter()
        self._closed_drops: Counter[DropReason] = Counter()
        self.attachment = Attachment(identity, policy, settings)
        self.attachment.claim(identity.subject, Right.ATTACH, (), is_global=True)

    @property
    def name(self) -> Name:
        """Return the member's name."""
        return self._identity.name

    @property
    def held_bytes(self) -> int:
        """Return how much memory unfinished messages hold."""
        return self._budget.held_bytes

    def drops(self) -> Mapping[DropReason, int]:
        """Return what was dropped, by reason."""
        total = self._drops + self._closed_drops + self.attachment.joiner.drops + self.attachment.refusals
        for publisher in self._publishers.values():
            total += publisher.drops
        for feed in self.feeds():
            total += feed.drops
        return total

    def add_port(self, index: int, mac: bytes, mtu: int, cost: int, now: Instant) -> None:
        """Begin to look for a switch on a port."""
        self.attachment.greeter.add_port(index, mac, mtu, cost, now.mono_s)

    def advertise(
        self,
        topic: Topic,
        description: bytes,
        *,
        reliable: bool,
        depth: int = 0,
        is_global: bool = True,
        urgent: bool = False,
    ) -> Publisher:
        """Publish a topic from now on.

        Raises:
            LocalError: not delegated to this member, or no secret for it.
        """
        if Right.PUBLISH not in topic.delegation.rights:
            raise LocalError(f"no delegation to publish {topic.name.short}")
        if topic.name in self._publishers:  # a second one would count, and make nonces, from 1 again
            raise LocalError(f"{topic.name.short} is published already")
        source = Source(self.name, self._incarnation, self._identity.key)
        publisher = Publisher(
            topic.name, source, topic.secrets, description, reliable=reliable, depth=depth, urgent=urgent
        )
        self._publishers[topic.name] = publisher
        (self._urgent if urgent else self._ordinary).append(publisher)
        delegation = topic.delegation
        self.attachment.claim(delegation.subject, Right.PUBLISH, delegation.chain, is_global=is_global)
        return publisher

    def subscribe(self, topic: Topic) -> None:
        """Read a topic from now on, from whoever may publish it.

        Raises:
            LocalError: not delegated to this member, or no secret for it.
        """
        if Right.READ not in topic.delegation.rights or not topic.secrets:
            raise LocalError(f"no delegation to read {topic.name.short}")
        self._subscriptions[topic.name] = _Subscription(topic)
        delegation = topic.delegation
        self.attachment.claim(delegation.subject, Right.READ, delegation.chain, is_global=False)

    def renew(self, topic: Topic) -> None:
        """Take a topic's delegation and secrets anew, for what is published or read of it."""
        publisher = self._publishers.get(topic.name)
        if publisher is not None:
            publisher.renew(topic.secrets)
            self.attachment.renew(topic.name, Right.PUBLISH, topic.delegation.chain)
        subscription = self._subscriptions.get(topic.name)
        if subscription is not None:
            subscription.topic = topic
            for feed in subscription.feeds.values():
                feed.renew(topic.secrets)
            self.attachment.renew(topic.name, Right.READ, topic.delegation.chain)

    def subscribed(self) -> list[Topic]:
        """Return the topics that are read."""
        return [subscription.topic for subscription in self._subscriptions.values()]

    def publishers(self) -> list[Publisher]:
        """Return what is being published, one publisher for each topic."""
        return list(self._publishers.values())

    def feeds(self) -> Iterator[Feed]:
        """Yield what is being read, one feed for each publisher of each topic."""
        for subscription in self._subscriptions.values():
            yield from subscription.feeds.values()

    def feeds_of(self, topic: Name) -> list[Feed]:
        """Return the feeds of one topic."""
        subscription = self._subscriptions.get(topic)
        return [] if subscription is None else list(subscription.feeds.values())

    def receive(self, arrivals: Sequence[Arrival], now: Instant) -> None:
        """Take frames in."""
        fed: dict[Feed, Name] = {}
        at = 0
        while at < len(arrivals):
            if self._under_way is not None:
                feed, topic = self._under_way
                taken = feed.receive_run(arrivals, at, now.mono_s)
                if taken:
                    fed[feed] = topic
                    at += taken
                    continue
            self._receive_one(arrivals[at], now, fed)
            at += 1
        for feed, topic in fed.items():
            self._messages += [Message(topic, each, feed.description) for each in feed.take_delivered()]
            report = feed.take_report(now.mono_s)
            if report is not None:
                self.attachment.send([report])

    def _receive_one(self, arrival: Arrival, now: Instant, fed: dict[Feed, Name]) -> None:
        try:
            header = decode(arrival.frame)
            if header.kind in _FOR_FEEDS:
                self._feed(header, arrival.frame, now.mono_s, fed)
            elif header.kind == Kind.REPORT:
                self._take_report(header, arrival.frame, now.mono_s)
            elif header.kind >= CONTROL_FROM:
                statement = self.attachment.receive_control(arrival, header, now)
                if statement is not None:
                    self._take_statement(statement, now)
            else:
                self._drops[DropReason.UNKNOWN_KIND] += 1
        except RemoteError as error:
            self._drops[error.reason] += 1

    def port_changed(self, port: int, up: bool, now: Instant) -> None:
        """Learn that a port's link came or went."""
        self.attachment.port_changed(port, up, now)

    def timeout(self, now: Instant) -> None:
        """Do what is due."""
        self.attachment.timeout(now)
        for publisher in self._publishers.values():
            publisher.timeout(now.mono_s)
        for feed in self.feeds():
            feed.timeout(now.mono_s)
        self.flush(now.mono_s)

    def flush(self, now_s: float) -> None:
        """Hand what publishers and feeds have ready to the switch."""
        if self.attachment.switch is None:
            return
        self._now_s = now_s
        self._may_send = False
        at_once = BYTES_BESIDE_URGENT if self._urgent else BYTES_AT_ONCE
        left = at_once
        for publisher in self._urgent:
            if frames := publisher.take(now_s, at_once):
                self.attachment.send(frames)
                self._may_send = True
                left -= sum(map(len, frames))
        if at_once // 2 < left < at_once:
            return  # it leaves now; the others' next chunk is sealed after that
        left = at_once
        for _ in range(len(self._ordinary)):
            if frames := self._ordinary[0].take(now_s, left):
                self.attachment.send(frames)
                self._may_send = True
                left -= sum(map(len, frames))
            self._ordinary.rotate(-1)
            if left < at_once // 2:
                break
        for feed in self.feeds():
            report = feed.take_report(now_s)
            if report is not None:
                self.attachment.send([report])

    def next_timeout(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        times = [self.attachment.next_timeout()]
        if self.attachment.switch is not None:  # alone, nothing can be sent: hellos alone are due
            times += [publisher.next_timeout() for publisher in self._publishers.values()]
            times += [feed.next_timeout() for feed in self.feeds()]
        return min((time for time in times if time is not None), default=None)

    def take(self) -> list[Transmit]:
        """Return, once, what is to be sent; more comes at the next call, until nothing does.

        So the first frames of a large message are on their way while the next ones are being sealed, and the topics
        take turns; urgent ones go first each time.
        """
        out = self.attachment.take()
        if not out and (self._may_send or any(publisher.has_new for publisher in self._publishers.values())):
            self.flush(self._now_s)
            out = self.attachment.take()
        return out

    def take_messages(self) -> list[Message]:
        """Return, once, the messages that arrived, in order within each feed."""
        messages, self._messages = self._messages, []
        return messages

    def leave(self) -> None:
        """Say goodbye: close feeds, withdraw every name."""
        for subscription in self._subscriptions.values():
            for feed in subscription.feeds.values():
                self.attachment.send([feed.close()])
            subscription.feeds.clear()
        self._under_way = None
        self.attachment.withdraw_all()

    def _feed(self, header: Header, frame: bytes, now_s: float, fed: dict[Feed, Name]) -> None:
        """Give a frame to the feed that it is for, and note that one."""
        subscription = self._subscriptions.get(header.destination)  # type: ignore[call-overload]
        feed = None if subscription is None else subscription.feeds.get(header.source)
        if feed is None:
            self._drops[DropReason.NOT_FOR_US] += 1
            return
        feed.receive(header, frame, now_s)
        fed[feed] = subscription.topic.name
        if header.parts > 1:
            self._under_way = feed, subscription.topic.name

    def _take_report(self, header: Header, frame: bytes, now_s: float) -> None:
        if header.destination != self.name:
            raise StatementError(DropReason.NOT_FOR_US)
        publisher = self._publishers.get(topic_of(header, frame))  # type: ignore[call-overload]
        if publisher is None:
            raise StatementError(DropReason.NOT_FOR_US)
        self._now_s = now_s
        self._may_send = True
        publisher.receive_report(header, frame, now_s)

    def _take_statement(self, statement: Statement, now: Instant) -> None:
        self._may_send = True
        if statement.type is StatementType.JOIN:
            join = Join.from_fields(statement.fields)
            publisher = self._publishers.get(join.topic)
            if publisher is not None and join.publisher == self.name and join.lease_s > 0:
                publisher.tree_stands(join.mtu)
        elif statement.type is StatementType.REVOKE:
            self._revoke(statement, now)
        elif statement.type is StatementType.ANSWER:
            self._take_publisher(Answer.from_fields(statement.fields), now)

    def _take_publisher(self, answer: Answer, now: Instant) -> None:
        subscription = self._subscriptions.get(answer.name)
        if subscription is None or answer.advertiser == self.name:
            return
        feed = subscription.feeds.get(answer.advertiser)
        if not answer.claim:
            if feed is not None:
                self._close(subscription, feed)
            return
        claim = self._verifier.verify(answer.claim, now.unix_s)
        if claim.right is not Right.PUBLISH or claim.name != answer.name or claim.node != answer.advertiser:
            raise StatementError(DropReason.WRONG_NAME, "a publisher's claim about something else")
        if feed is not None:
            if claim.sequence <= feed.claim_sequence:
                return
            if feed.incarnation == claim.incarnation:
                feed.claim_sequence, feed.claim = claim.sequence, claim.wire
                return
            self._close(subscription, feed)
        topic = subscription.topic
        feed = Feed(
            topic.name,
            self._reader,
            claim.node,
            claim.incarnation,
            claim.member.key,
            topic.secrets,
            self._budget,
            now.mono_s,
        )
        feed.claim_sequence, feed.claim = claim.sequence, claim.wire
        subscription.feeds[claim.node] = feed

    def _revoke(self, statement: Statement, now: Instant) -> None:
        """Open nothing more of a publisher whose claim rests on what was taken back."""
        if self._verifier.revoke(statement.wire, now.unix_s) is None:
            return
        for subscription in self._subscriptions.values():
            for feed in list(subscription.feeds.values()):
                try:
                    self._verifier.verify(feed.claim, now.unix_s)
                except StatementError as error:
                    self._drops[error.reason] += 1
                    self._close(subscription, feed)

    def _close(self, subscription: _Subscription, feed: Feed) -> None:
        self.attachment.send([feed.close()])
        self._under_way = None
        self._closed_drops += feed.drops
        del subscription.feeds[feed.publisher]
