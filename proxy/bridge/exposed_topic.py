"""Exposed topic: messages of local publishers are received, rate-limited, bounded, encoded and published.

I/O through endpoint and participant. The publishers are live nodes, or those of a recording.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence

from gdp.client.participant import Topic
from gdp.client.publisher import Publisher
from gdp.client.send_options import is_urgent
from gdp.control.topic_control import GIVE, SHOW, TAKE
from gdp.errors import LocalError
from gdp.intervals import READER
from gdp.message.loss import LossReason
from gdp.names import Name
from gdp.trust.advertisement import paths_value
from proxy.bridge.context import BridgeContext
from proxy.bridge.control_services import ControlServices
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.core.encoder import MessageEncoder, description_of
from proxy.bridge.core.reduction import adaptation_of, encoders_of
from proxy.bridge.core.stream_qos import Change, LiveQos, RecordedQos, StreamQos
from proxy.bridge.depth_probe import DepthProbe
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.bridge.faults import Fault
from proxy.bridge.liveliness import Party
from proxy.bridge.rate_limit import RateLimiter
from proxy.endpoints.core.endpoint import EndpointError, Event, GraphEntity, MessageReceived, TypeResolved
from proxy.serial.channel import Channel
from proxy.wire.message import RosMessage


class ExposedTopic:
    """Carries one local topic to the overlay while a local publisher exists.

    Attributes:
        handle: of the endpoint's subscription.
        publisher: the overlay's publisher of the topic; None until the endpoint has described it.
        published: messages published, by channel, including those without a reader.
        published_bytes: their bytes in ROS's wire form.
        local_publishers: how many there are on this machine.
        taken: local messages received; ``thinned``: of these, what the rule's rate left out.
        last_s: monotonic second of the newest; None: there was none.

    Raises:
        LocalError: this machine does not know the type.
    """

    def __init__(
        self,
        context: BridgeContext,
        dispatcher: EndpointDispatcher,
        flow_spec: FlowSpec,
        topic: Topic,
        ends: Sequence[GraphEntity],
    ) -> None:
        self._context = context
        self._dispatcher = dispatcher
        self._flow_spec = flow_spec
        self._topic = topic
        self.qos: StreamQos = (
            LiveQos(flow_spec.rule, ends) if dispatcher.endpoint.is_live else RecordedQos(flow_spec.rule)
        )
        self.publisher: Publisher | None = None
        self.published = Counter[int]()
        self.published_bytes = Counter[int]()
        self.taken = 0
        self.thinned = 0
        self.last_s: float | None = None
        self._channels: tuple[Channel, ...] = ()  # as the endpoint describes them
        self._encoders: list[MessageEncoder] = []
        self._ends, self.local_publishers = ends, len(ends)
        self._depth_probe: DepthProbe | None = None
        self._keys = {end.key for end in ends}
        self._new_encoder = encoders_of(flow_spec.rule)
        self._pace = RateLimiter(flow_spec.rule.max_hz)
        self._adaptation = adaptation_of(flow_spec.rule)
        self.handle = self._subscribe()
        try:
            # Remote readers may come before a message.
            self._describe((dispatcher.endpoint.channel(flow_spec.local, flow_spec.type_name),))
        except LocalError:
            self.publisher = None  # the first message brings its definition
        acts = () if flow_spec.rule.control is None or not dispatcher.endpoint.is_live else (TAKE, GIVE, SHOW)
        self._control = ControlServices(context, dispatcher, flow_spec, self._readers, *acts)

    def follow(self, ends: Sequence[GraphEntity]) -> None:
        """Update the local publishers."""
        if ends == self._ends:
            return
        self._ends, self.local_publishers = ends, len(ends)
        probe, keys = self._depth_probe, {end.key for end in ends}
        is_other, self._keys = keys != self._keys, keys
        if is_other and probe is not None:
            probe.close()
            self._depth_probe = None
            self.qos.set_depth(None)
        change = self.qos.receive_publishers(ends)
        if change is Change.NONE and not (is_other and probe is not None and probe.depth is not None):
            return
        if change is Change.SUBSCRIPTION:
            self._dispatcher.close(self.handle)
            self.handle = self._subscribe()
        if self._channels:
            self._describe(self._channels)

    def has_space(self) -> bool:
        """Return whether a message may be published without dropping one that a reader still lacks."""
        return self.publisher is None or self.publisher.has_space()

    def handle_event(self, event: Event, now_s: float) -> None:
        """Process an event of the subscription."""
        if isinstance(event, MessageReceived):
            self._publish(event, now_s)
        elif isinstance(event, TypeResolved):
            self._describe((event.channel, *event.others))
        elif isinstance(event, EndpointError):
            self._context.report_error(self._flow_spec.local, event, Fault.QOS)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return None if self._depth_probe is None else self._depth_probe.get_timer()

    def handle_timer(self, now_s: float) -> None:
        """Keep as much for late joiners as the local publisher does, once that is known."""
        if self._depth_probe is not None and self._depth_probe.handle_timer(now_s):
            self.qos.set_depth(self._depth_probe.depth)
            self._describe(self._channels)

    def finish(self, now_s: float) -> None:
        """Publish nothing from now on."""
        if self._depth_probe is not None:
            self._depth_probe.close()
        self._control.close()
        self._dispatcher.close(self.handle)
        self._context.member.flush(now_s)

    def close(self, now_s: float) -> None:
        """Close the subscription and the publisher; unconfirmed messages are lost."""
        self.finish(now_s)
        if self.publisher is not None:
            if self._context.keeper is not None:
                self._context.keeper.release(self._topic.name, time.time())
            self._context.member.withdraw(self._topic.name)

    def parties(self, now_s: float) -> list[Party]:
        """Return the readers that are known now."""
        del now_s
        publisher = self.publisher
        if publisher is None:
            return []
        readers = publisher.matched
        return [Party("reader", Name(each).to_text(), is_silent=readers.is_suspended(each)) for each in readers.names()]

    def renew(self, topic: Topic) -> None:
        """Replace the delegation."""
        self._topic = topic
        if self.publisher is not None:
            self._context.member.renew(topic)

    def _readers(self) -> list[Name]:
        return [] if self.publisher is None else list(map(Name, self.publisher.matched.names()))

    def _subscribe(self) -> int:
        return self._dispatcher.subscribe(self, self._flow_spec.local, self._flow_spec.type_name, self.qos.request)

    def _describe(self, channels: Sequence[Channel]) -> None:
        rule = self._flow_spec.rule
        self._channels = tuple(channels)
        described = self.qos.describe(channels, rule.global_name_of(self._flow_spec.local))
        self._encoders = [self._new_encoder(channel) for channel in described]
        opaque = {each.serializer.opaque for each in self._encoders if each.serializer.opaque}
        if opaque and rule.encoding != "cdr":
            detail = f"messages travel as bytes, unread: {', '.join(sorted(opaque))}"
            self._context.faults.report(self._flow_spec.local, Fault.UNKNOWN_TYPE, detail)
        for fault, why in {each.obstacle for each in self._encoders if each.obstacle is not None}:
            self._context.faults.report(self._flow_spec.local, fault, f"messages are not reduced: {why}")
        wire = description_of(rule, described).to_wire()
        if self.publisher is not None:
            self.publisher.describe(wire)
            self.publisher.set_depth(self.qos.depth)
            self.publisher.set_options(self.qos.options)
            return
        self.publisher = self._context.member.advertise(
            self._topic,
            wire,
            reliable=self.qos.is_reliable,
            depth=self.qos.depth,
            is_global=rule.is_global,
            urgent=is_urgent(rule.priority),
            paths=paths_value(rule.paths),
            options=self.qos.options,
        )
        keeper = self._context.keeper
        if rule.keep is None or keeper is None:
            return
        if obstacle := keeper.keep(self._flow_spec.local, self._topic, self.publisher, rule.keep, time.time()):
            self._context.faults.report(self._flow_spec.local, Fault.NOT_KEPT, obstacle)

    def _publish(self, event: MessageReceived, now_s: float) -> None:
        rule, publisher, traffic = self._flow_spec.rule, self.publisher, self._context.traffic
        if publisher is None:
            return  # the description always comes first: an earlier message belongs to a subscription that was replaced
        self.taken += 1
        if self._context.keeper is not None:
            self._context.keeper.handle_event(self._flow_spec.local, self._context.faults)
        if self.last_s is None and self._dispatcher.endpoint.is_live:
            publisher.await_readers(now_s + READER.lease_s)  # the path to readers that wait may come later
        self.last_s = now_s
        if self.qos.asks_depth:
            if self._depth_probe is None:
                spec = self._flow_spec
                self._depth_probe = DepthProbe(self._dispatcher, spec.local, spec.type_name, self.qos.request)
            self._depth_probe.handle_message(now_s)
        if not self._pace.may_pass(now_s):
            traffic.thinned += 1
            self.thinned += 1
            return
        if len(event.raw) > rule.max_bytes:
            detail = f"a message of {len(event.raw)} bytes; the rule's max_bytes is {rule.max_bytes}"
            self._context.faults.report(self._flow_spec.local, Fault.TOO_LARGE, detail)
            publisher.skip(LossReason.TOO_LARGE, now_s)
            return
        if not publisher.is_wanted and not publisher.queue.kept and publisher.queue.recorder is None:
            traffic.unread += 1
            publisher.skip(LossReason.NO_READER, now_s)
            self._count(event)
            return
        adaptation, path = self._adaptation, publisher.governing_paths
        acknowledged = publisher.acknowledgements.acknowledged
        if not adaptation.may_send(publisher.losses, acknowledged, path.bytes_s, now_s):
            traffic.thinned += 1
            return
        has_space = publisher.has_space()
        if not has_space:
            adaptation.handle_refused(now_s)
            self._context.faults.report(
                self._flow_spec.local, Fault.TOO_FAST, "messages come faster than readers confirm them"
            )
            if publisher.queue.recorder is None:
                publisher.skip(LossReason.WINDOW_OVERFLOW, now_s)
                return
        body, steps = self._encoders[event.channel].encode(event.raw, adaptation.quality)
        head = RosMessage(event.channel, event.stamp_ns, body, steps).head
        if not has_space:
            publisher.skip(LossReason.WINDOW_OVERFLOW, now_s, head + body)
            return
        size = len(head) + len(body)
        try:
            count = publisher.publish(body, now_s, head)
        except LocalError as error:
            self._context.faults.report(self._flow_spec.local, Fault.TOO_LARGE, str(error))
            publisher.skip(LossReason.TOO_LARGE, now_s)
            return
        if count is not None:
            adaptation.handle_sent(count, size, now_s)
        traffic.sent(size)
        self._count(event)

    def _count(self, event: MessageReceived) -> None:
        self.published[event.channel] += 1
        self.published_bytes[event.channel] += len(event.raw)
