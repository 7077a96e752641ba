"""A topic of local publishers on its way out: heard, thinned, bounded, encoded, published.

Place: shell; endpoint and member do the I/O. The publishers are live nodes, or those of a recording.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from gdp.client.member import Topic
from gdp.client.publisher import Publisher
from gdp.errors import LocalError
from gdp.message.loss import LossReason
from proxy.bridge.pace import Pace
from proxy.bridge.seat import Seat
from proxy.bridge.site import Site
from proxy.bridge.stream_qos import Change, LiveQos, RecordedQos, StreamQos
from proxy.bridge.wishes import Wish
from proxy.endpoints.endpoint import Described, End, Event, Faulted, Heard
from proxy.faults import Fault
from proxy.parcel import Description, Parcel
from proxy.serial.channel import Channel
from proxy.serial.serializer import Serializer

__all__ = ["ExposedTopic"]


class ExposedTopic:
    """Carries one local topic out, for as long as somebody local publishes it.

    Attributes:
        handle: of the endpoint's subscription.
        publisher: the overlay's publisher of the topic; None until the endpoint has described it.
        published: messages published, by channel, those that nobody read included.
        published_bytes: their bytes, as ROS wrote them.

    Raises:
        LocalError: this machine does not know the type.
    """

    def __init__(self, site: Site, seat: Seat, wish: Wish, topic: Topic, ends: Sequence[End]) -> None:
        self._site = site
        self._seat = seat
        self._wish = wish
        self._topic = topic
        self._qos: StreamQos = LiveQos(wish.rule, ends) if seat.endpoint.is_live else RecordedQos(wish.rule)
        self.publisher: Publisher | None = None
        self.published = Counter[int]()
        self.published_bytes = Counter[int]()
        self._channels: tuple[Channel, ...] = ()  # as the endpoint describes them
        self._serializers: list[Serializer] = []
        self._pace = Pace(wish.rule.max_hz)
        self.handle = self._subscribe()
        try:
            # far readers may come before a message
            self._describe((seat.endpoint.channel(wish.local, wish.type_name),))
        except LocalError:
            self.publisher = None  # the first message brings its definition

    def follow(self, ends: Sequence[End]) -> None:
        """Learn who publishes now."""
        change = self._qos.receive_publishers(ends)
        if change is Change.NONE:
            return
        if change is Change.SUBSCRIPTION:
            self._seat.close(self.handle)
            self.handle = self._subscribe()
        if self._channels:
            self._describe(self._channels)

    def has_room(self) -> bool:
        """Return whether a message may be published without pushing out one that a reader still lacks."""
        return self.publisher is None or self.publisher.has_room()

    def take(self, event: Event, now_s: float) -> None:
        """Take what the endpoint says of the subscription."""
        if isinstance(event, Heard):
            self._publish(event, now_s)
        elif isinstance(event, Described):
            self._describe((event.channel, *event.others))
        elif isinstance(event, Faulted):
            self._site.tell(self._wish.local, event, Fault.QOS)

    def close(self, now_s: float) -> None:
        """Carry nothing any more."""
        self._seat.close(self.handle)
        if self.publisher is not None:
            self._site.member.flush(now_s)  # what was said last must not wait: it would go with its stream
            self._site.member.withdraw(self._topic.name)

    def renew(self, topic: Topic) -> None:
        """Take the delegation anew."""
        self._topic = topic
        if self.publisher is not None:
            self._site.member.renew(topic)

    def _subscribe(self) -> int:
        return self._seat.subscribe(self, self._wish.local, self._wish.type_name, self._qos.request)

    def _describe(self, channels: Sequence[Channel]) -> None:
        rule = self._wish.rule
        self._channels = tuple(channels)
        described = self._qos.describe(channels, rule.global_name_of(self._wish.local))
        self._serializers = [Serializer(channel, rule.encoding) for channel in described]
        opaque = {each.opaque for each in self._serializers if each.opaque}
        if opaque and rule.encoding != "cdr":
            detail = f"messages travel as bytes, unread: {', '.join(sorted(opaque))}"
            self._site.faults.tell(self._wish.local, Fault.UNKNOWN_TYPE, detail)
        wire = Description(rule.encoding, described).to_wire()
        if self.publisher is not None:
            self.publisher.describe(wire)
            self.publisher.set_depth(self._qos.depth)
            return
        self.publisher = self._site.member.advertise(
            self._topic,
            wire,
            reliable=self._qos.is_reliable,
            depth=self._qos.depth,
            is_global=rule.is_global,
            urgent=rule.priority == "urgent",
        )

    def _publish(self, event: Heard, now_s: float) -> None:
        rule, publisher, traffic = self._wish.rule, self.publisher, self._site.traffic
        if publisher is None:
            return  # described first, always: what comes before is of a subscription that was replaced
        if not self._pace.may_pass(now_s):
            traffic.thinned += 1
            return
        if len(event.raw) > rule.max_bytes:
            detail = f"a message of {len(event.raw)} bytes; the rule's max_bytes is {rule.max_bytes}"
            self._site.faults.tell(self._wish.local, Fault.TOO_LARGE, detail)
            publisher.skip(LossReason.TOO_LARGE)
            return
        if not publisher.is_wanted and not self._qos.depth:
            traffic.unread += 1
            publisher.skip(LossReason.NO_READER)
            self._count(event)
            return
        if not publisher.has_room():
            self._site.faults.tell(self._wish.local, Fault.TOO_FAST, "messages come faster than readers confirm them")
            publisher.skip(LossReason.WINDOW_OVERFLOW)
            return
        body = self._serializers[event.channel].encode(event.raw)
        message = Parcel(event.channel, event.stamp_ns, body).to_wire()
        try:
            publisher.publish(message)
        except LocalError as error:
            self._site.faults.tell(self._wish.local, Fault.TOO_LARGE, str(error))
            publisher.skip(LossReason.TOO_LARGE)
            return
        traffic.sent(len(message))
        self._count(event)

    def _count(self, event: Heard) -> None:
        self.published[event.channel] += 1
        self.published_bytes[event.channel] += len(event.raw)
