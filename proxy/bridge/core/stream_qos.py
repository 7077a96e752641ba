"""QoS of an exposed topic on the overlay: derived from its local publishers, or kept as recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from typing import Protocol

from gdp.client.send_options import SendOptions
from gdp.config.offered_qos import OFFERED_DEPTH_MAX
from proxy.config.rule import Rule
from proxy.endpoints.core.endpoint import GraphEntity
from proxy.endpoints.core.qos import DEPTH_MAX, deadline_s, default, is_depth_unknown, kept, request, shared_depth
from proxy.serial.channel import QOS_MAX, Channel, Qos


class Change(Enum):
    """Consequence of a change among the local publishers."""

    NONE = "none"
    DESCRIPTION = "description"  # remote readers must receive it
    SUBSCRIPTION = "subscription"  # and only a new subscription matches them


class StreamQos(Protocol):
    """QoS of the overlay's publisher of one local topic."""

    @property
    def request(self) -> Qos | None:
        """Return the QoS to request from local publishers; None: the endpoint's default."""

    @property
    def is_reliable(self) -> bool:
        """Return whether readers request messages that they miss."""

    @property
    def depth(self) -> int:
        """Return the number of messages for late joiners."""

    @property
    def profile(self) -> Qos | None:
        """Return one profile that all publishers fulfil, for machines that do not read yet; None: not known."""

    @property
    def options(self) -> SendOptions:
        """Return how fresh, how much and how often messages leave."""

    @property
    def asks_depth(self) -> bool:
        """Return whether only a probe shows what the local publisher keeps."""

    def set_depth(self, depth: int | None) -> None:
        """Set what a probe found; None: another publisher is there."""

    def receive_publishers(self, ends: Sequence[GraphEntity]) -> Change:
        """Update the local publishers; return the consequence."""

    def describe(self, channels: Sequence[Channel], topic: str) -> tuple[Channel, ...]:
        """Set the channels that the endpoint describes; return them in the form for remote readers.

        Args:
            topic: the name that all sides use.
        """


class LiveQos:
    """QoS from the publishers of a live graph, whose messages come as one channel."""

    def __init__(self, rule: Rule, ends: Sequence[GraphEntity]) -> None:
        self._rule = rule
        self._publishers, self._offers = len(ends), _offers(ends)
        self._is_latched = False
        self._found_depth: int | None = None

    @property
    def request(self) -> Qos | None:
        """Return a profile that matches every local publisher; None while their QoS is unknown."""
        return request(self._offers) if self._offers else None

    @property
    def is_reliable(self) -> bool:
        """Return the rule's value, else whether every local publisher is reliable."""
        if self._rule.wants_reliable is not None:
            return self._rule.wants_reliable
        return not self._offers or request(self._offers).reliability == "reliable"

    @property
    def depth(self) -> int:
        """Return the number of messages for late joiners."""
        if self._rule.history is not None:
            return self._rule.history.messages
        if self._rule.wants_latched is False:
            return 0
        if self._rule.latched or self._is_latched:
            shared = shared_depth(self._publishers) if self._is_latched and self._publishers > 1 else 1
            return max(kept(self._offers, self._found_depth), shared)
        return kept(self._offers, self._found_depth)

    @property
    def profile(self) -> Qos | None:
        """Return the profile that matches every local publisher, with what late joiners get."""
        if self.depth:
            reliable = not self._offers or request(self._offers).reliability == "reliable"
            return default(reliable=reliable, latched=True, depth=self.depth)
        return self.request

    @property
    def asks_depth(self) -> bool:
        """Return whether only a probe shows what the local publisher keeps."""
        rule = self._rule
        return rule.history is None and rule.wants_latched is not False and is_depth_unknown(self._offers)

    def set_depth(self, depth: int | None) -> None:
        """Set what a probe found; None: another publisher is there."""
        self._found_depth = depth

    @property
    def options(self) -> SendOptions:
        """Return the rule's values; where it has no deadline, that of the local publishers."""
        return self._rule.send_options(deadline_s(self._offers))

    def receive_publishers(self, ends: Sequence[GraphEntity]) -> Change:
        """Update the local publishers; return the consequence."""
        publishers, offers, depth = self._publishers, self._offers, self.depth
        self._publishers, self._offers = len(ends), _offers(ends)
        if (publishers, offers) == (self._publishers, self._offers):
            return Change.NONE
        # A publisher that joins a latched topic may evict another's latched message before the graph shows it.
        if request(offers) != request(self._offers) or 0 < depth < self.depth:
            return Change.SUBSCRIPTION
        return Change.DESCRIPTION

    def describe(self, channels: Sequence[Channel], topic: str) -> tuple[Channel, ...]:
        """Return the channel with the profiles as offered; the depth is that of the messages kept, if any."""
        channel = channels[0]
        self._is_latched = channel.latched
        latched = bool(self.depth)
        offers = self._offers or channel.qos or ((default(latched=True),) if latched else ())
        known = dict.fromkeys(replace(each, depth=min(self.depth, OFFERED_DEPTH_MAX) or each.depth) for each in offers)
        return (replace(channel, topic=topic, latched=latched, qos=tuple(known)[:QOS_MAX]),)


class RecordedQos:
    """QoS of the channels of a recording, unchanged; only rules make a topic best-effort."""

    def __init__(self, rule: Rule) -> None:
        self._rule = rule
        self._recorded_depth = 0
        self._recorded_deadline_s: float | None = None

    @property
    def request(self) -> Qos | None:
        """Return None: a recording offers everything."""
        return None

    @property
    def is_reliable(self) -> bool:
        """Return the rule's value, else True."""
        return self._rule.reliable

    @property
    def depth(self) -> int:
        """Return the largest recorded depth of a latched channel, and at least 1 where the rule latches."""
        if self._rule.history is not None:
            return self._rule.history.messages
        return max(self._recorded_depth, int(self._rule.latched))

    @property
    def profile(self) -> Qos | None:
        """Return None: no machine shares the names of a recording."""
        return None

    @property
    def options(self) -> SendOptions:
        """Return the rule's values; where it has no deadline, that of the recorded publishers."""
        return self._rule.send_options(self._recorded_deadline_s)

    @property
    def asks_depth(self) -> bool:
        """Return False: it is recorded."""
        return False

    def set_depth(self, depth: int | None) -> None:
        """Ignore it: it is recorded."""

    def receive_publishers(self, ends: Sequence[GraphEntity]) -> Change:
        """Return NONE: the publishers of a recording do not change."""
        del ends
        return Change.NONE

    def describe(self, channels: Sequence[Channel], topic: str) -> tuple[Channel, ...]:
        """Return the channels under the topic name that all sides use."""
        self._recorded_deadline_s = deadline_s([profile for channel in channels for profile in channel.qos])
        self._recorded_depth = max(map(_recorded_depth, channels), default=0)
        return tuple(replace(channel, topic=topic) for channel in channels)


def _recorded_depth(channel: Channel) -> int:
    if not channel.latched:
        return 0
    return min(max((profile.depth for profile in channel.qos), default=1) or 1, DEPTH_MAX)


def _offers(ends: Sequence[GraphEntity]) -> tuple[Qos, ...]:
    return tuple(end.qos for end in sorted(ends, key=lambda end: end.key) if end.qos is not None)
