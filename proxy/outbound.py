"""Messages from a local endpoint on their way to the overlay: encoded, bounded, published.

Place: shell, without I/O of its own.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from gdp.client.member import Topic
from gdp.client.publisher import Publisher
from gdp.message.loss import LossReason
from gdp.names import Name
from proxy.config import Rule
from proxy.node import ProxyNode
from proxy.parcel import Description, Parcel
from proxy.serial.channel import Channel
from proxy.serial.serializer import Serializer

__all__ = ["Outbound"]

log = logging.getLogger(__name__)

DEPTH_MAX: Final = 64  # messages kept for late joiners of one topic


@dataclass(frozen=True, slots=True)
class _Way:
    publisher: Publisher
    serializer: Serializer
    number: int  # of the channel within its topic
    max_bytes: int


class Outbound:
    """Publishes the channels that rules expose; what no rule names stays local.

    Args:
        topics: what the node may do with the rules' names.
        channels: of the endpoint; those with one topic are one topic on the overlay, too.

    Raises:
        LocalError: a channel whose type is not the rule's, or one that may not be published.
    """

    def __init__(
        self, node: ProxyNode, rules: Sequence[Rule], topics: Mapping[Name, Topic], channels: Sequence[Channel]
    ) -> None:
        self._node = node
        self._topics = topics
        self._ways: dict[int, _Way] = {}
        self.publishers: dict[str, Publisher] = {}
        self.channels_of: dict[str, list[int]] = {}  # by topic
        self.too_large = 0
        by_topic = {(rule.name, rule.type_name): rule for rule in rules}
        for key, rule in by_topic.items():
            indexes = [at for at, channel in enumerate(channels) if (channel.topic, channel.type_name) == key]
            if indexes:
                self._expose(rule, indexes, channels)

    def is_exposed(self, channel: int) -> bool:
        """Return whether a rule names this channel."""
        return channel in self._ways

    def has_room(self, channel: int) -> bool:
        """Return whether a message may go now without pushing out one that a reader still lacks."""
        return self._ways[channel].publisher.has_room()

    def publish(self, channel: int, raw: bytes) -> bool:
        """Publish one message; return False when it is above the rule's limit.

        Its publisher counts it as unconfirmed when nobody reads the topic, and readers find it lost.
        """
        way = self._ways[channel]
        stamp_ns = time.time_ns()
        if len(raw) > way.max_bytes:
            self.too_large += 1
            log.warning("message too large topic=%s bytes=%d", way.serializer.channel.topic, len(raw))
            way.publisher.skip(LossReason.TOO_LARGE)
            return False
        message = Parcel(way.number, stamp_ns, way.serializer.encode(raw)).to_wire()
        way.publisher.publish(message)
        self._node.traffic.sent(len(message))
        self._node.member.flush(time.monotonic())
        return True

    def _expose(self, rule: Rule, indexes: Sequence[int], channels: Sequence[Channel]) -> None:
        mine = tuple(channels[at] for at in indexes)
        depth = max((_depth(channel) for channel in mine), default=0)
        if rule.latched:
            depth = max(depth, 1)
        publisher = self._node.member.advertise(
            self._topics[rule.overlay_name],
            Description(rule.encoding, mine).to_wire(),
            reliable=rule.reliable,
            depth=depth,
            is_global=rule.is_global,
            urgent=rule.priority == "urgent",
        )
        self.publishers[rule.name] = publisher
        self.channels_of[rule.name] = list(indexes)
        for number, at in enumerate(indexes):
            serializer = Serializer(channels[at], rule.encoding)
            if serializer.opaque:
                log.warning("messages travel opaque topic=%s reason=%s", rule.name, serializer.opaque)
            self._ways[at] = _Way(publisher, serializer, number, rule.max_bytes)


def _depth(channel: Channel) -> int:
    """Return how many messages late joiners of a channel want."""
    if not channel.latched:
        return 0
    return min(max((profile.depth for profile in channel.qos), default=1) or 1, DEPTH_MAX)
