"""Imported topic: joined while a local node reads it, then decoded, converted and published here.

I/O through endpoint and participant. The local publisher (``local_output``) exists as long as the rule does, so that
local tools see the topic. The overlay's tree exists while a local reader does. A recording reads always. Under
exclusive control the messages of its holder pass, and its silence is answered here.
"""

from __future__ import annotations

import secrets
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

from gdp.capsule.late_join import LateJoin
from gdp.client.delivery import Delivered
from gdp.client.participant import Message, Topic
from gdp.control.topic_control import GIVE
from gdp.due_queue import earliest
from gdp.errors import DropReason, LocalError, RemoteError
from gdp.extras import MissingExtraError
from gdp.intervals import UPKEEP_S
from gdp.message.loss import Losses
from gdp.names import Name
from gdp.trust.advertisement import paths_value
from proxy.bridge.context import BridgeContext
from proxy.bridge.control_services import ControlServices
from proxy.bridge.core.decoder import MessageDecoder, differences_of
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.core.exclusive_control import ExclusiveControl
from proxy.bridge.core.reduction import MessageExpander, expander_of
from proxy.bridge.core.topic_stats import SAMPLES_MAX, TopicStats
from proxy.bridge.decoder_cache import DecoderCache
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.bridge.faults import Fault
from proxy.bridge.liveliness import Party
from proxy.bridge.local_output import ChannelPublishers, LocalOutput, MergedPublisher
from proxy.bridge.rate_limit import RateLimiter
from proxy.endpoints.core.endpoint import EndpointError, Event, GraphEntity, Origin
from proxy.endpoints.core.qos import unmatched
from proxy.serial.channel import Channel
from proxy.serial.headers import HeaderRewriter, StampShift
from proxy.serial.schema import DefinitionError
from proxy.wire.message import HEAD_BYTES, RosMessage, TopicDescription

_HEARD_MAX = 1_024  # publishers
_SAMPLES_MAX = 4_096  # latencies kept of a live topic


class _Decoded(NamedTuple):
    """Expander, decoder, rewriter of headers and output of one remote channel."""

    expander: MessageExpander
    incoming: MessageDecoder
    headers: HeaderRewriter | None  # where the rule renames frames, or converts stamps
    handle: int  # of the local output


class ImportedTopic:
    """Carries one remote topic to the local graph.

    Attributes:
        local_readers: how many there are on this machine.
        thinned: messages that the rule's rate left out.
        last_s: monotonic second of the newest message that arrived; None: there was none.
        is_joined: whether it is subscribed: a local node reads it.
        control: who is heard; None: every publisher.
        unmatched: node and policy of each local reader whose QoS is not met, by key.

    Raises:
        LocalError: this graph does not accept a publisher of it, or the rule's message of stop does not fit its type.
    """

    def __init__(
        self, context: BridgeContext, dispatcher: EndpointDispatcher, flow_spec: FlowSpec, topic: Topic
    ) -> None:
        self._context = context
        self._flow_spec = flow_spec
        self._topic = topic
        self._ends: Sequence[GraphEntity] = ()  # local readers
        self.unmatched: dict[str, tuple[str, str]] = {}
        self._sources = DecoderCache[tuple[_Decoded, ...]]()
        self.is_joined = False
        self._look_s = 0.0  # when publishers are looked for next, where local readers have a lease of liveliness
        self._past: LateJoin | None = None
        self.local_readers = 0
        self._past_losses = Losses()  # losses of earlier subscriptions
        self._pace = RateLimiter(flow_spec.rule.max_hz)
        self.thinned = 0
        self.last_s: float | None = None
        samples = _SAMPLES_MAX if dispatcher.endpoint.is_live else SAMPLES_MAX
        self.stats = TopicStats(
            topic=flow_spec.local, type_name=flow_spec.type_name, latencies_ms=deque(maxlen=samples)
        )
        self.control: ExclusiveControl | None = None
        self._stop: Callable[[], bytes] | None = None  # returns the message of stop, once the type is known
        if flow_spec.rule.control is not None and dispatcher.endpoint.is_live:
            self.control = ExclusiveControl(flow_spec.rule.control.silence_s, secrets.randbits(32))
            try:
                known = dispatcher.endpoint.channel(flow_spec.local, flow_spec.type_name)
            except LocalError:
                known = None  # the far side's definition may serve
            if known is not None:
                self._prepare_stop(known)
        kind = MergedPublisher if dispatcher.endpoint.is_live else ChannelPublishers
        self._heard_s: dict[bytes, float] = {}  # when each publisher's last message came, the latest last
        self._output: LocalOutput = kind(dispatcher, self, flow_spec)
        acts = () if self.control is None else (GIVE,)
        self._services = ControlServices(context, dispatcher, flow_spec, lambda: [context.member.name], *acts)

    def follow(self, ends: Sequence[GraphEntity]) -> None:
        """Update the local readers."""
        self._ends, self.local_readers = ends, len(ends)
        if ends and not self.is_joined:
            self.is_joined = True
            keeper, history = self._context.keeper, self._flow_spec.rule.history
            if history is not None and keeper is not None:
                self._past = keeper.join(self._flow_spec.local, self._topic, history, self._deliver_past)
            paths = paths_value(self._flow_spec.rule.paths)
            self._context.member.subscribe(self._topic, paths=paths, head_bytes=HEAD_BYTES)
        elif not ends and self.is_joined:
            self._leave()
            self._output.drop_kept()
        self._output.receive_readers(ends)
        self._tell_unmatched()
        self._sources.forget_refused()  # other types may fit now

    def receive(self, message: Message, now_s: float) -> None:
        """Process a message of the overlay."""
        publisher = message.delivered.publisher
        self._heard_s.pop(publisher, None)
        self._heard_s[publisher] = now_s
        if len(self._heard_s) > _HEARD_MAX:
            del self._heard_s[next(iter(self._heard_s))]
        if self._past is not None:
            self._past.receive_live(message, now_s)
            self._deliver_past(now_s)
        else:
            self._pass(message, now_s)

    def _deliver_past(self, now_s: float) -> None:
        for message in () if self._past is None else self._past.poll_messages():
            self._pass(message, now_s)

    def _pass(self, message: Message, now_s: float) -> None:
        publisher = message.delivered.publisher
        if not self._context.contain(self._flow_spec.local, publisher, now_s, self._receive, message, now_s):
            self.stats.refused += 1

    def _receive(self, message: Message, now_s: float) -> None:
        try:
            self._deliver(message, now_s)
        except MissingExtraError as error:
            self._refuse(Fault.NO_LIBRARY, str(error))
        except LocalError as error:
            self._refuse(Fault.REFUSED, str(error))

    def handle_event(self, event: Event, now_s: float) -> None:
        """Process an event of the local publisher."""
        del now_s
        if isinstance(event, EndpointError):
            self._context.report_error(self._flow_spec.local, event, Fault.QOS)

    @property
    def publishers(self) -> dict[Name, str]:
        """Return the labels of the publishers that have a route and the right to publish, by name."""
        proxies = self._context.member.subscriptions.writer_proxies_of(self._topic.name)
        return {
            each.publisher: "" if each.advertisement is None else each.advertisement.member.label for each in proxies
        }

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        control_s = None if self.control is None else self.control.get_timer()
        return earliest(control_s, self._look_s if self.has_lease else None)

    @property
    def has_lease(self) -> bool:
        """Return whether local readers are to learn that no remote publisher is left."""
        return self._output.has_lease

    def handle_timer(self, now_s: float) -> None:
        """Publish the message of stop when the holder of control is silent or gone; look after a lease."""
        if self.has_lease and self._look_s <= now_s:
            self._look_s = now_s + UPKEEP_S
            self._output.set_alive(bool(self.publishers))
        if self.control is None or not self.control.poll_stop(self.publishers, now_s) or self._stop is None:
            return
        try:
            self._output.publish(0, self._stop(), Origin(time.time_ns(), 0))
        except LocalError as error:
            self._refuse(Fault.REFUSED, str(error))

    def parties(self, now_s: float) -> list[Party]:
        """Return the publishers that are known now."""
        names = list(self.publishers)
        self._heard_s = {name: self._heard_s[name] for name in names if name in self._heard_s}
        ago_s = {name: now_s - heard_s for name, heard_s in self._heard_s.items()}
        control = {} if self.control is None else {name: name == self.control.holder for name in names}
        return [Party("publisher", name.to_text(), ago_s.get(name), has_control=control.get(name)) for name in names]

    def close(self, now_s: float) -> None:
        """Close the subscription and the local publisher."""
        self._services.close()
        if self.control is not None:
            self.control.give(None, now_s)
            self.handle_timer(now_s)
        if self.is_joined:
            self._leave()
        self.count_losses()
        self._output.close()

    def renew(self, topic: Topic) -> None:
        """Replace the delegation."""
        self._topic = topic
        if self.is_joined:
            self._context.member.renew(topic)

    def set_offered(self, flow_spec: FlowSpec) -> None:
        """Replace the QoS that the far side states; it holds until a publisher is known."""
        self._flow_spec = flow_spec
        self._output.set_offered(flow_spec)

    def count_losses(self) -> None:
        """Update the losses in the topic's statistics."""
        self.stats.losses = losses = Losses()
        losses.update(self._past_losses)
        if self.is_joined:
            losses.update(self._context.member.subscriptions.losses_of(self._topic.name))

    def _leave(self) -> None:
        self.is_joined = False
        if self._past is not None and self._context.keeper is not None:
            self._context.keeper.leave(self._topic.name)
        self._past = None
        self._past_losses.update(self._context.member.subscriptions.losses_of(self._topic.name))
        self._context.member.unsubscribe(self._topic.name)

    def _tell_unmatched(self) -> None:
        """Report once each reader whose QoS is not met."""
        offered = self._output.fulfilled
        policies = ((end, unmatched(end.qos, offered)) for end in self._ends if end.qos is not None)
        odd = {end.key: (end.node or "a node", policy) for end, policy in policies if policy}
        for key in odd.keys() - self.unmatched.keys():
            detail = "{} will get nothing: {}".format(*odd[key])
            self._context.faults.report(self._flow_spec.local, Fault.QOS, detail)
        if self.unmatched and not odd:
            self._context.faults.clear(self._flow_spec.local, Fault.QOS)
        self.unmatched = odd

    def _refuse(self, fault: Fault, detail: str) -> None:
        self.stats.refused += 1
        self._context.faults.report(self._flow_spec.local, fault, detail)

    def _deliver(self, message: Message, now_s: float) -> None:
        delivered, traffic, rule = message.delivered, self._context.traffic, self._flow_spec.rule
        publisher = delivered.publisher
        if (publisher, message.description) not in self._sources:
            self._sources.put(publisher, message.description, None)
            ready = self._describe(publisher, TopicDescription.from_cbor(message.description))
            self._sources.put(publisher, message.description, ready)
        channels = self._sources.get(publisher, message.description)
        if channels is None or not self._output.is_open:
            self.stats.refused += 1
            return
        if self.control is not None and not self._has_control(self.control, delivered, now_s):
            return
        self.last_s = now_s
        if not self._pace.may_pass(now_s):
            traffic.thinned += 1
            self.thinned += 1
            return
        ros_message = RosMessage.from_wire(delivered.message, delivered.head)
        if ros_message.channel >= len(channels):
            self._refuse(Fault.MALFORMED, f"a message of channel {ros_message.channel}, of {len(channels)} described")
            return
        expander, incoming, headers, handle = channels[ros_message.channel]
        raw = incoming.decode(*expander.expand(ros_message))
        clock = self._context.clock_of(publisher, now_s)
        ahead_ns = 0 if clock is None else round(1e9 * clock.offset_s)
        if headers is not None:
            by_ns = -ahead_ns if rule.stamps == "local" else 0
            raw = headers.rewrite(raw, StampShift(by_ns, ros_message.stamp_ns))
        if len(raw) > rule.max_bytes:
            detail = f"a message of {len(raw)} bytes; the rule's max_bytes is {rule.max_bytes}"
            self._refuse(Fault.TOO_LARGE, detail)
            return
        self._output.publish(handle, raw, Origin(ros_message.stamp_ns, delivered.sequence))
        if self._context.keeper is not None:
            self._context.keeper.handle_event(self._flow_spec.local, self._context.faults)
        differs = clock is not None and clock.least_s > 0  # else the bound lets both be equal, and one time stays so
        latency_ms = (time.time_ns() - ros_message.stamp_ns + (ahead_ns if differs else 0)) / 1e6
        self.stats.count_number(delivered.publisher, delivered.incarnation, delivered.number, delivered.place)
        self.stats.add(latency_ms, delivered.parts, delivered.hops, len(raw))
        traffic.latency.observe(latency_ms / 1e3)
        traffic.received(len(delivered.head) + len(delivered.message))

    def _has_control(self, control: ExclusiveControl, delivered: Delivered, now_s: float) -> bool:
        """Return whether a message may steer: its publisher holds control, and sent it a short time ago."""
        publisher, least_s = delivered.publisher, 0.0
        stamp_ns = RosMessage.from_wire(delivered.message, delivered.head).stamp_ns
        if (clock := self._context.clock_of(publisher, now_s)) is not None:
            least_s = (time.time_ns() - stamp_ns) / 1e9 + clock.offset_s - clock.bound_s
        reason = control.refusal(publisher, stamp_ns, least_s, now_s)
        if reason is None:
            return True
        self._context.member.subscriptions.drops[reason] += 1
        if reason is DropReason.NOT_IN_CONTROL:
            detail = f"{Name(publisher).short} publishes without the control of this topic"
            self._context.faults.report(self._flow_spec.local, Fault.NOT_IN_CONTROL, detail)
        return False

    def _prepare_stop(self, channel: Channel) -> None:
        """Find the form of the message of stop. Raises ``LocalError``: the rule's fields do not fit the type."""
        from proxy.serial.rosbridge_json import RosbridgeCodec  # most topics are under no control

        codec, settings = RosbridgeCodec(channel), self._flow_spec.rule.control
        stop = {} if settings is None else settings.stop
        try:
            codec.to_raw(stop)
        except RemoteError as error:
            raise LocalError(f"control: stop does not fit {self._flow_spec.type_name}: {error.detail}") from error
        self._stop = lambda: codec.to_raw(stop, time.time_ns())

    def _describe(self, publisher: bytes, description: TopicDescription) -> tuple[_Decoded, ...] | None:
        """Prepare the decoders of a publisher's channels; None if this graph cannot have them."""
        what, sources = self._flow_spec.local, description.channels
        other = next((each.type_name for each in sources if each.type_name != self._flow_spec.type_name), None)
        if other is not None:
            self._context.faults.report(what, Fault.OTHER_TYPE, f"the far side sends {other}")
            return None
        try:
            incoming = [self._output.decoder(source, description.encoding) for source in sources]
            expanders = [expander_of(description, source, self._flow_spec.rule.max_bytes) for source in sources]
            rewriters = [self._rewriter(each.target) for each in incoming]
            if self.control is not None and self._stop is None:
                self._prepare_stop(incoming[0].target)
        except DefinitionError as error:
            self._context.faults.report(what, Fault.OTHER_TYPE, f"the far side's definition does not fit: {error}")
            return None
        if differences := differences_of(incoming):
            self._context.faults.report(what, Fault.OTHER_TYPE, differences)
        try:
            handles = self._output.add(publisher, sources, [each.target for each in incoming])
        except LocalError as error:
            self._context.faults.report(what, self._output.refusal, str(error))
            return None
        self._tell_unmatched()
        return tuple(map(_Decoded, expanders, incoming, rewriters, handles))

    def _rewriter(self, channel: Channel) -> HeaderRewriter | None:
        rule = self._flow_spec.rule
        has_stamps = rule.stamps == "local"
        if rule.frames is None:
            return HeaderRewriter(channel, None, has_stamps=True) if has_stamps else None
        return HeaderRewriter(channel, rule.frames.rename, has_stamps=has_stamps)
