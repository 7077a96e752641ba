"""What a member hears on its names, and from whom: a feed for each party whose claim holds.

Place: pure; time comes in as ``now_s`` (monotonic seconds).

Whose word counts is decided here, by the claim that the switch hands on and this member verifies itself: a reader hears
who publishes, a server who calls, a client who serves. What a server answers one client, or a client asks one server,
comes by a second feed from the same party, made when something does.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from gdp.client.delivery import Delivered
from gdp.client.feed import Ended, Feed, FeedState
from gdp.client.identities import ReaderIdentity
from gdp.client.key_epochs import Secrets
from gdp.client.private import Life, PrivateFeed, private_incarnation, private_name
from gdp.control.query import Answer
from gdp.effects import Instant
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import Header
from gdp.limits import CALL_IDLE_S
from gdp.message.join import VerifiesDigest
from gdp.message.loss import Losses, LossReason, LostRange
from gdp.message.memory import Budget
from gdp.names import Name
from gdp.trust.claim import Claim
from gdp.trust.delegation import Delegation
from gdp.trust.lru import Lru
from gdp.trust.right import HEARS, Right
from gdp.trust.verifier import ClaimVerifier

__all__ = ["Change", "Message", "Subscription", "Subscriptions", "Topic"]

ENDED_MAX: Final = 4_096  # closed feeds whose end is remembered
ABSENT_MAX: Final = 1_024  # publishers of one topic that went, and may come back
_NOWHERE: Final = Ended()


class Message(NamedTuple):
    """A message that arrived, and what its publisher says the topic's messages are.

    ``private``: a server's answer, or a client's request to one server; for nobody else.
    """

    topic: Name
    delivered: Delivered
    description: bytes
    private: bool = False


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
class Subscription:
    """One name that is heard, by which right, and the feeds of it.

    Attributes:
        private: by writer.
        absent: publishers whose route has ended, in which life, and where their feeds were.
        past_losses: of feeds that are gone.
    """

    topic: Topic
    right: Right
    feeds: dict[Name, Feed] = field(default_factory=dict)
    private: dict[Name, PrivateFeed] = field(default_factory=dict)
    absent: dict[Name, tuple[int, Ended]] = field(default_factory=dict)
    past_losses: Losses = field(default_factory=Losses)

    def losses(self) -> Losses:
        """Return what was lost of everything that is heard on this name."""
        losses = Losses()
        losses.update(self.past_losses)
        for feed in self.all():
            losses.update(feed.losses)
        return losses

    def forget_absent(self, party: Name, why: LossReason) -> None:
        """Expect nothing any more of a life of a publisher that went; what is known to lack of it is lost."""
        _, ended = self.absent.pop(party)
        if ended.sequence < ended.known:
            self.past_losses.add(LostRange(ended.sequence, ended.known - 1, why))

    def all(self) -> list[Feed]:
        """Return every feed."""
        return [*self.feeds.values(), *self.private.values()]

    def take(self, source: Name) -> list[Message]:
        """Return, once, the messages of one source; private ones not before it has said what they are."""
        feed, topic = self.feeds.get(source), self.topic.name
        if feed is None:
            return []
        messages = [Message(topic, each, feed.description) for each in feed.take_delivered()]
        private = self.private.get(source)
        if private is not None and feed.state is FeedState.LIVE:
            messages += [Message(topic, each, feed.description, True) for each in private.take_delivered()]
        return messages


class _Way(NamedTuple):
    """By which a party may say something to us alone."""

    subscription: Subscription
    stream: Name
    verifier: VerifiesDigest


class Change(NamedTuple):
    """Feeds that began, and that are to be closed: no frame finds them any more; and the last messages of these."""

    opened: list[Feed]
    ended: list[Feed]
    rest: list[Message]


class Subscriptions:
    """All that one member hears.

    Args:
        reader: the member.
    """

    def __init__(self, reader: ReaderIdentity, verifier: ClaimVerifier) -> None:
        self._reader = reader
        self._verifier = verifier
        self._budget = Budget()
        self._by_name: dict[Name, Subscription] = {}
        self._ways: dict[tuple[bytes, int], _Way] = {}  # by writer and incarnation, as headers have them
        self._ended: Lru[Ended] = Lru(ENDED_MAX)
        self.drops: Counter[DropReason] = Counter()  # of feeds that are gone, and of claims
        self._past_losses: Counter[LossReason] = Counter()  # on names that are heard no more

    def __iter__(self) -> Iterator[Subscription]:
        return iter(self._by_name.values())

    @property
    def held_bytes(self) -> int:
        """Return how much memory unfinished messages hold."""
        return self._budget.held_bytes

    def lost(self) -> Counter[LossReason]:
        """Return how many messages were lost, by reason."""
        return sum((each.losses().counts for each in list(self._by_name.values())), self._past_losses)

    def get(self, name: Name) -> Subscription | None:
        """Return what is heard on a name, or None."""
        return self._by_name.get(name)

    def add(self, topic: Topic, right: Right) -> None:
        """Hear others on a name from now on."""
        self._by_name[topic.name] = Subscription(topic, right)

    def remove(self, name: Name) -> list[Feed]:
        """Hear nobody on a name any more; return the feeds that are to be closed."""
        subscription = self._by_name.pop(name, None)
        if subscription is None:
            return []
        ended = self._end_all(subscription)
        self._past_losses += subscription.losses().counts
        return ended

    def find(self, header: Header, now_s: float) -> tuple[Subscription, Feed] | None:
        """Return whose frame this is, if it is anybody's."""
        subscription = self._by_name.get(header.destination)  # type: ignore[call-overload]
        if subscription is not None:
            feed = subscription.feeds.get(header.source)
            return None if feed is None else (subscription, feed)
        if header.destination != self._reader.name:
            return None
        way = self._ways.get((header.source, header.incarnation))
        return None if way is None else (way.subscription, self._private_feed(way, Name(header.source), now_s))

    def take(self, answer: Answer, now: Instant) -> Change:
        """Take what the switch says of somebody: its claim, or that it is gone.

        Raises:
            StatementError: the claim does not hold, is about something else, or newer than what is gone.
        """
        subscription, change = self._by_name.get(answer.name), Change([], [], [])
        if subscription is None or answer.advertiser == self._reader.name:
            return change
        feed = subscription.feeds.get(answer.advertiser)
        if not answer.claim:
            if feed is not None and feed.claim_sequence > answer.sequence:
                raise StatementError(DropReason.STALE, "gone, of an earlier claim")
            return change if feed is None else Change([], self._detach(subscription, answer.advertiser), [])
        claim = self._verifier.verify(answer.claim, now.unix_s)
        is_heard = HEARS[subscription.right] is claim.right
        if not is_heard or claim.name != answer.name or claim.node != answer.advertiser:
            raise StatementError(DropReason.WRONG_NAME, "a claim about something else")
        self._reader.notes.shared(claim.exchange)  # or it is refused before anything changes
        if feed is not None:
            if claim.sequence <= feed.claim_sequence:
                return change
            if feed.incarnation == claim.incarnation:
                feed.claim_sequence, feed.claim = claim.sequence, claim
                return change
            feed.finish()
            rest = [Message(answer.name, each, feed.description) for each in feed.take_delivered()]
            change = Change([], self._detach(subscription, claim.node), rest)
        return change._replace(opened=self._open(subscription, claim, now.mono_s))

    def has_issuer(self, key: bytes) -> bool:
        """Return whether a claim that is heard rests on a certificate that this key, 33 bytes, issued."""
        feeds = (feed for subscription in self._by_name.values() for feed in subscription.feeds.values())
        return any(feed.claim is not None and key in feed.claim.issuers for feed in feeds)

    def recheck(self, fingerprint: bytes, unix_s: float) -> list[Feed]:
        """Return the feeds that are to be closed, for their party's claim rested on what was revoked."""
        ended: list[Feed] = []
        for subscription in self._by_name.values():
            for feed in list(subscription.feeds.values()):
                if feed.claim is None or fingerprint not in feed.claim.fingerprints:
                    continue
                try:
                    self._verifier.recheck(feed.claim, unix_s)
                except StatementError as error:
                    self.drops[error.reason] += 1
                    ended += self._detach(subscription, feed.publisher)
        return ended

    def leave(self) -> list[Feed]:
        """Return all feeds, which are to be closed."""
        return [feed for subscription in self._by_name.values() for feed in self._end_all(subscription)]

    def _open(self, subscription: Subscription, claim: Claim, now_s: float) -> list[Feed]:
        topic, reader, party = subscription.topic, self._reader, claim.node
        ended = self._ended.get(topic.name + _key(party, claim.incarnation)) or _NOWHERE
        life, before = subscription.absent.get(party, (claim.incarnation, ended))
        if life == claim.incarnation:
            ended = before
            subscription.absent.pop(party, None)
        else:
            subscription.forget_absent(party, LossReason.PUBLISHER_RESTARTED)
        feed = Feed(
            topic=topic.name,
            reader=reader,
            publisher=party,
            incarnation=claim.incarnation,
            writer=claim.member.key,
            exchange=claim.exchange,
            secrets=topic.secrets,
            budget=self._budget,
            now_s=now_s,
            ended=ended,
            restarted=life != claim.incarnation,
        )
        feed.claim_sequence, feed.claim = claim.sequence, claim
        subscription.feeds[party] = feed
        if subscription.right is Right.SERVE:
            feed.idle_s = CALL_IDLE_S
        if subscription.right is not Right.READ:
            stream = self._stream_from(topic.name, feed)
            self._ways[party, private_incarnation(stream)] = _Way(subscription, stream, claim.member.key)
        return [feed]

    def _private_feed(self, way: _Way, writer: Name, now_s: float) -> PrivateFeed:
        """Return what a party says to us alone."""
        subscription = way.subscription
        feed = subscription.private.get(writer)
        if feed is None:
            public, ended = subscription.feeds[writer], self._ended.get(way.stream) or _NOWHERE
            feed = subscription.private[writer] = PrivateFeed(
                name=way.stream,
                reader=self._reader,
                public=public,
                verifier=way.verifier,
                secrets=subscription.topic.secrets,
                budget=self._budget,
                now_s=now_s,
                ended=ended,
            )
        return feed

    def _stream_from(self, topic: Name, feed: Feed) -> Name:
        """Return the name of the stream by which the publisher of a feed says something to us alone."""
        reader = Life(self._reader.name, self._reader.incarnation)
        return private_name(topic, Life(feed.publisher, feed.incarnation), reader)

    def _end_all(self, subscription: Subscription) -> list[Feed]:
        for party in list(subscription.absent):
            subscription.forget_absent(party, LossReason.DETACHED)
        return [feed for party in list(subscription.feeds) for feed in self._end(subscription, party)]

    def _detach(self, subscription: Subscription, party: Name) -> list[Feed]:
        """End the feeds of a party that may come back, in this life or another."""
        feed = subscription.feeds[party]
        if feed.ended.sequence:
            subscription.absent[party] = feed.incarnation, feed.ended._replace(resumes=True)
        if len(subscription.absent) > ABSENT_MAX:
            subscription.forget_absent(next(iter(subscription.absent)), LossReason.DETACHED)
        return self._end(subscription, party)

    def _end(self, subscription: Subscription, party: Name) -> list[Feed]:
        feed = subscription.feeds.pop(party)
        subscription.past_losses.update(feed.losses)
        self._remember(subscription.topic.name + _key(party, feed.incarnation), feed)
        self._ways.pop((party, private_incarnation(self._stream_from(subscription.topic.name, feed))), None)
        private = subscription.private.pop(party, None)
        if private is None:
            return [feed]
        subscription.past_losses.update(private.losses)
        self._remember(private.topic, private)
        return [feed, private]

    def _remember(self, key: bytes, feed: Feed) -> None:
        self._ended.put(key, feed.ended)
        self.drops += feed.drops


def _key(name: Name, incarnation: int) -> bytes:
    return name + incarnation.to_bytes(8, "big")
