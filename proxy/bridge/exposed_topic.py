"""A topic of local publishers on its way out: heard, thinned, bounded, encoded, published.

Place: shell; endpoint and member do the I/O.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gdp.client.member import Topic
from gdp.client.publisher import Publisher
from gdp.errors import LocalError
from gdp.message.loss import LossReason
from proxy.bridge.pace import Pace
from proxy.bridge.seat import Seat
from proxy.bridge.site import Site
from proxy.bridge.wishes import Wish
from proxy.endpoints.endpoint import Described, End, Event, Faulted, Heard
from proxy.faults import Fault
from proxy.parcel import Description, Parcel
from proxy.qos import DEPTH_MAX, default, kept, request
from proxy.serial.channel import Channel, Qos
from proxy.serial.serializer import Serializer

__all__ = ["ExposedTopic"]


class ExposedTopic:
    """Carries one local topic out, for as long as somebody local publishes it.

    Raises:
        LocalError: this machine does not know the type.
    """

    def __init__(self, site: Site, seat: Seat, wish: Wish, topic: Topic, ends: Sequence[End]) -> None:
        self._site = site
        self._seat = seat
        self._wish = wish
        self._topic = topic
        self._ends, self._offers = len(ends), _offers(ends)
        self._publisher: Publisher | None = None
        self._channel: Channel | None = None  # as the endpoint describes it
        self._serializer: Serializer | None = None
        self._is_latched = False
        self._pace = Pace(wish.rule.max_hz)
        self._handle = self._subscribe()
        try:
            self._describe(seat.endpoint.channel(wish.local, wish.type_name))  # far readers may come before a message
        except LocalError:
            self._publisher = None  # the first message brings its definition

    def follow(self, ends: Sequence[End]) -> None:
        """Learn who publishes now."""
        before, depth = (self._ends, self._offers), self._depth()
        self._ends, self._offers = len(ends), _offers(ends)
        if before == (self._ends, self._offers):
            return
        # One that joins a latched topic may have spoken, and pushed out what another latched, before it was seen.
        if request(before[1]) != request(self._offers) or 0 < depth < self._depth():
            self._seat.close(self._handle)
            self._handle = self._subscribe()
        if self._channel is not None:
            self._describe(self._channel)

    def take(self, event: Event, now_s: float) -> None:
        """Take what the endpoint says of the subscription."""
        if isinstance(event, Heard):
            self._publish(event, now_s)
        elif isinstance(event, Described):
            self._describe(event.channel)
        elif isinstance(event, Faulted):
            self._site.tell(self._wish.local, event, Fault.QOS)

    def close(self, now_s: float) -> None:
        """Carry nothing any more."""
        self._seat.close(self._handle)
        if self._publisher is not None:
            self._site.member.flush(now_s)  # what was said last must not wait: it would go with its stream
            self._site.member.withdraw(self._topic.name)

    def renew(self, topic: Topic) -> None:
        """Take the delegation anew."""
        self._topic = topic
        if self._publisher is not None:
            self._site.member.renew(topic)

    def _subscribe(self) -> int:
        qos = request(self._offers) if self._offers else None
        return self._seat.subscribe(self, self._wish.local, self._wish.type_name, qos)

    def _describe(self, channel: Channel) -> None:
        rule = self._wish.rule
        self._channel, self._is_latched = channel, channel.latched
        latched = bool(self._depth())
        offers = (request(self._offers),) if self._offers else channel.qos
        if offers or latched:
            profile = offers[0] if offers else default(latched=True)
            offers = (replace(profile, depth=self._depth() or profile.depth),)
        described = replace(channel, topic=rule.global_name_of(self._wish.local), latched=latched, qos=offers)
        self._serializer = Serializer(described, rule.encoding)
        if self._serializer.opaque and rule.encoding != "cdr":
            detail = f"messages travel as bytes, unread: {self._serializer.opaque}"
            self._site.faults.tell(self._wish.local, Fault.UNKNOWN_TYPE, detail)
        wire = Description(rule.encoding, (described,)).to_wire()
        if self._publisher is not None:
            self._publisher.describe(wire)
            self._publisher.set_depth(self._depth())
            return
        self._publisher = self._site.member.advertise(
            self._topic,
            wire,
            reliable=self._is_reliable(),
            depth=self._depth(),
            is_global=rule.is_global,
            urgent=rule.priority == "urgent",
        )

    def _is_reliable(self) -> bool:
        if self._wish.rule.wants_reliable is not None:
            return self._wish.rule.wants_reliable
        return not self._offers or request(self._offers).reliability == "reliable"

    def _depth(self) -> int:
        """Return how many messages late joiners get."""
        if self._wish.rule.wants_latched is False:
            return 0
        if self._wish.rule.latched or self._is_latched:
            return max(kept(self._offers), DEPTH_MAX if self._is_latched and self._ends > 1 else 1)
        return kept(self._offers)

    def _publish(self, event: Heard, now_s: float) -> None:
        rule, publisher, serializer, traffic = self._wish.rule, self._publisher, self._serializer, self._site.traffic
        if publisher is None or serializer is None:
            return  # described first, always: what comes before is of a subscription that was replaced
        if not self._pace.may_pass(now_s):
            traffic.thinned += 1
            return
        if len(event.raw) > rule.max_bytes:
            detail = f"a message of {len(event.raw)} bytes; the rule's max_bytes is {rule.max_bytes}"
            self._site.faults.tell(self._wish.local, Fault.TOO_LARGE, detail)
            publisher.skip(LossReason.TOO_LARGE)
            return
        if not publisher.is_wanted and not self._depth():
            traffic.unread += 1
            publisher.skip(LossReason.NO_READER)
            return
        if not publisher.has_room():
            self._site.faults.tell(self._wish.local, Fault.TOO_FAST, "messages come faster than readers confirm them")
            publisher.skip(LossReason.WINDOW_OVERFLOW)
            return
        message = Parcel(0, event.stamp_ns, serializer.encode(event.raw)).to_wire()
        try:
            publisher.publish(message)
        except LocalError as error:
            self._site.faults.tell(self._wish.local, Fault.TOO_LARGE, str(error))
            publisher.skip(LossReason.TOO_LARGE)
            return
        traffic.sent(len(message))


def _offers(ends: Sequence[End]) -> tuple[Qos, ...]:
    return tuple(end.qos for end in sorted(ends, key=lambda end: end.key) if end.qos is not None)
