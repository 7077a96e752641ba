"""Comparison of a received recording with the sent one, topic by topic.

I/O, reading only. A message is kept as a digest of 16 bytes, so memory does not grow with the recording's bytes. Order
is guaranteed per publisher: if several publish one topic, each publisher's messages are compared in their order.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path
from typing import Final, TypeAlias

from proxy.recordings.reader import BagReader
from proxy.serial.channel import Channel
from proxy.serial.serializer import canonical

_DIGEST_BYTES: Final = 16
_Publisher: TypeAlias = "str | None"


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicComparison:
    """Result for one topic.

    Args:
        messages: sent.
        bytes: sent, in ROS's wire form.
        delivered: sent messages that arrived with the same bytes.
        lost: sent messages that did not.
        duplicated: arrivals beyond the first of a sent message.
        altered: arrivals that were never sent.
        identical: nothing lost, nothing altered.
        in_order: each publisher's arrivals come in the order of sending.
    """

    topic: str
    type_name: str
    messages: int
    bytes: int
    delivered: int
    lost: int
    duplicated: int
    altered: int
    identical: bool
    in_order: bool


@dataclass(slots=True)
class _Side:
    """Messages of a topic in one recording."""

    type_name: str = ""
    size: int = 0
    arrivals: list[tuple[_Publisher, bytes]] = field(default_factory=list)

    def all(self) -> Counter[bytes]:
        return Counter(digest for _, digest in self.arrivals)

    def publishers(self) -> set[_Publisher]:
        return {publisher for publisher, _ in self.arrivals}

    def stream(self, publisher: _Publisher) -> list[bytes]:
        return [digest for who, digest in self.arrivals if who == publisher]


def compare(sent: Path | str, received: Path | str, *, exact: bool) -> list[TopicComparison]:
    """Compare two recordings; topics in the order of the first.

    Args:
        exact: compare the exact bytes; otherwise topics whose bytes differ are compared in canonical form.

    Raises:
        ConfigError: one of them cannot be read at all.
    """
    before = _read(sent, None, as_is=True)
    after = _read(received, None, as_is=True)
    if not exact:
        unlike = {topic for topic, side in before.items() if topic in after and side.all() != after[topic].all()}
        if unlike:
            before.update(_read(sent, unlike, as_is=False))
            after.update(_read(received, unlike, as_is=False))
    topics = [*before, *(topic for topic in after if topic not in before)]
    return [_judge(topic, before.get(topic, _Side()), after.get(topic, _Side())) for topic in topics]


def compare_digests(
    topic: str, type_name: str, size: int, sent: Iterable[bytes], arrived: Iterable[bytes]
) -> TopicComparison:
    """Compare one publisher's messages, ``size`` bytes in all, with the arrivals; each message is given by a digest."""
    before = _Side(type_name, size, [(None, digest) for digest in sent])
    return _judge(topic, before, _Side(type_name, 0, [(None, digest) for digest in arrived]))


def _read(path: Path | str, only: Collection[str] | None, *, as_is: bool) -> dict[str, _Side]:
    sides: dict[str, _Side] = {}
    with BagReader(path) as bag:
        for channel in bag.channels:
            if only is None or channel.topic in only:
                sides.setdefault(channel.topic, _Side(channel.type_name))
        for channel, raw in _chosen(bag, sides):
            side = sides[channel.topic]
            side.size += len(raw)
            form = raw if as_is else canonical(channel, raw)
            side.arrivals.append((channel.callerid, blake2b(form, digest_size=_DIGEST_BYTES).digest()))
    return sides


def _chosen(bag: BagReader, topics: Collection[str]) -> Iterator[tuple[Channel, bytes]]:
    for message in bag.messages():
        channel = bag.channels[message.channel]
        if channel.topic in topics:
            yield channel, message.raw


def _judge(topic: str, before: _Side, after: _Side) -> TopicComparison:
    sent = before.all()
    arrived = after.all()
    messages = sent.total()
    delivered = (sent & arrived).total()
    altered = sum(count for digest, count in arrived.items() if digest not in sent)
    return TopicComparison(
        topic=topic,
        type_name=before.type_name or after.type_name,
        messages=messages,
        bytes=before.size,
        delivered=delivered,
        lost=messages - delivered,
        duplicated=arrived.total() - delivered - altered,
        altered=altered,
        identical=messages == delivered and not altered,
        in_order=_all_in_order(before, after),
    )


def _all_in_order(before: _Side, after: _Side) -> bool:
    publishers = after.publishers()
    if publishers <= before.publishers():
        return all(_in_order(before.stream(who), after.stream(who)) for who in publishers)
    # The receiver did not record the publisher.
    return _in_order([digest for _, digest in before.arrivals], [digest for _, digest in after.arrivals])


def _in_order(sent: list[bytes], arrived: list[bytes]) -> bool:
    """Return whether the known arrivals are a subsequence of what was sent; repeats are allowed.

    A repeat of the newest arrival, or of an earlier one, is a duplicate and no disorder.
    """
    known = Counter(sent)
    seen: Counter[bytes] = Counter()
    rest = iter(sent)
    for digest in arrived:
        if digest not in known:
            continue
        seen[digest] += 1
        if seen[digest] > known[digest]:
            continue
        if not any(digest == other for other in rest):
            return False
    return True
