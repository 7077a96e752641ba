"""Session of one Foxglove client.

Sans-I/O. Source: see ``foxglove_protocol.py``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from gdp.errors import DropReason, RemoteError
from gdp_extensions.doors.core import foxglove_protocol as protocol
from gdp_extensions.doors.core.client_queue import ClientQueue, Pending
from gdp_extensions.doors.core.hub import REASON_MAX, Hub, Publication, TopicType
from gdp_extensions.doors.core.parameter_calls import ParameterCall, ParameterCalls
from proxy.serial.channel import Channel, Service

SUBSCRIPTIONS_MAX: Final = 4_096
CALLS_MAX: Final = 1_024
SCHEMAS_MAX: Final = 4 << 20  # characters of the schemas of a client's channels
_SLOW: Final = "slow"  # number of the status that tells of dropped messages


@dataclass(frozen=True, slots=True)
class _Call:
    service: int
    call: int


class FoxgloveSession:
    """State of one connection."""

    def __init__(self, hub: Hub, number: int, name: str, queue: ClientQueue) -> None:
        self._hub = hub
        self.number = number
        self.queue = queue
        self._offered: dict[int, Publication] = {}
        self._subscriptions: dict[int, int] = {}  # to channels
        self._readers: dict[int, int] = {}  # of channels, to subscriptions
        self._channels: dict[int, protocol.ClientChannel] = {}
        self._calls = 0
        self._parameters = ParameterCalls(
            hub,
            self,
            lambda values, request: queue.put_control(protocol.parameter_values(values, request)),
            self.tell_wrong,
        )
        queue.put_control(protocol.server_info(name, f"{name}-{number}"))

    def handle_message(self, data: str | bytes, now_ns: int) -> None:
        """Process a message of the client. Raises ``RemoteError``: it is malformed, and was ignored."""
        message = protocol.parse(data)
        if isinstance(message, protocol.PublishMessage):
            self._publish(message, now_ns)
        elif isinstance(message, protocol.SubscribeChannels):
            for subscription in message.subscriptions:
                self._subscribe(subscription)
            self._hub.update_graph()
        elif isinstance(message, protocol.UnsubscribeChannels):
            for number in message.numbers:
                self._unsubscribe(number)
            self._hub.update_graph()
        elif isinstance(message, protocol.CallService):
            self._call(message)
        elif isinstance(message, protocol.GetParameters):
            self._parameters.get(message.names, message.number)
        elif isinstance(message, protocol.SetParameters):
            self._parameters.set(message.parameters, message.number)
        elif isinstance(message, protocol.AdvertiseChannels):
            for channel in message.channels:
                self._advertise(channel)
            self._hub.update_graph()
        else:
            for number in message.numbers:
                if self._channels.pop(number, None) is None:
                    self.tell_wrong(f"unadvertise: no channel {number} was advertised")
            self._hub.update_graph()

    def tell_wrong(self, reason: str) -> None:
        """Report an error."""
        self.queue.put_control(protocol.status(protocol.ERROR, reason[:REASON_MAX]))

    def tell_dropped(self, total: int) -> None:
        """Report the messages that were dropped, in a status that replaces the earlier one."""
        text = f"this client reads too slowly: {total} messages were dropped for it; other clients lose nothing"
        self.queue.put_control(protocol.status(protocol.WARNING, text, _SLOW))

    def encode(self, pending: Pending) -> bytes:
        """Return the binary message of a subscription."""
        return protocol.message_data(pending.key, pending.stamp_ns, pending.raw)

    def get_timer(self) -> float | None:
        """Return None: nothing of this session waits for a time."""
        return None

    def handle_timer(self, now_s: float) -> None:
        """Do nothing: see ``get_timer``."""

    def reads(self) -> Iterable[TopicType]:
        """Return the topics of the subscriptions."""
        found = (self._offered.get(channel) for channel in self._readers)
        return [(each.channel.topic, each.channel.type_name) for each in found if each is not None]

    def publishes(self) -> Iterable[TopicType]:
        """Return the topics of the client's channels."""
        return [(each.topic, each.type_name) for each in self._channels.values()]

    def schema_of(self, topic: str, type_name: str) -> Channel | None:
        """Return the schema of a channel that the client advertised with one."""
        for each in self._channels.values():
            if (each.topic, each.type_name) == (topic, type_name) and each.schema_encoding == "ros2msg":
                return Channel(topic, type_name, 2, definition=each.schema, definition_format="msg")
        return None

    def add_publication(self, publication: Publication) -> None:
        """Advertise a channel."""
        self._offered[publication.number] = publication
        self.queue.put_control(protocol.advertise([(publication.number, publication.channel)]))

    def remove_publication(self, publication: Publication) -> None:
        """Withdraw a channel, with the client's subscription to it."""
        del self._offered[publication.number]
        if (number := self._readers.get(publication.number)) is not None:
            self._unsubscribe(number)
            self._hub.update_graph()
        self.queue.put_control(protocol.unadvertise([publication.number]))

    def queue_message(self, publication: Publication, stamp_ns: int, raw: bytes) -> None:
        """Queue a message if the client subscribed to its channel."""
        if (number := self._readers.get(publication.number)) is not None:
            self.queue.put(number, stamp_ns, raw)

    def add_service(self, handle: int, service: Service) -> None:
        """Advertise a service."""
        self.queue.put_control(protocol.advertise_services([(handle, service)]))

    def remove_service(self, handle: int, service: Service) -> None:
        """Withdraw a service."""
        del service
        self.queue.put_control(protocol.unadvertise_services([handle]))

    def pass_answer(self, context: object, raw: bytes) -> None:
        """Send a response."""
        if isinstance(context, ParameterCall):
            self._parameters.pass_answer(context, raw)
        elif isinstance(context, _Call):
            self._calls -= 1
            self.queue.put_control(protocol.service_response(context.service, context.call, raw))

    def pass_refusal(self, context: object, reason: str) -> None:
        """Send the reason of a failed call."""
        if isinstance(context, ParameterCall):
            self._parameters.pass_refusal(context, reason)
        elif isinstance(context, _Call):
            self._calls -= 1
            self.queue.put_control(protocol.service_failure(context.service, context.call, reason))

    def _subscribe(self, wanted: protocol.Subscription) -> None:
        publication = self._offered.get(wanted.channel)
        if publication is None:
            self.tell_wrong(f"subscribe: there is no channel {wanted.channel}")
        elif wanted.number in self._subscriptions:
            self.tell_wrong(f"subscribe: number {wanted.number} is in use")
        elif wanted.channel in self._readers:
            self.tell_wrong(f"subscribe: {publication.channel.topic} is subscribed already")
        elif len(self._subscriptions) >= SUBSCRIPTIONS_MAX:
            self.tell_wrong(f"subscribe: more than {SUBSCRIPTIONS_MAX} subscriptions")
        else:
            self._subscriptions[wanted.number] = wanted.channel
            self._readers[wanted.channel] = wanted.number
            for stamp_ns, raw in publication.kept:
                self.queue.put(wanted.number, stamp_ns, raw)

    def _unsubscribe(self, number: int) -> None:
        channel = self._subscriptions.pop(number, None)
        if channel is None:
            self.tell_wrong(f"unsubscribe: there is no subscription {number}")
            return
        del self._readers[channel]
        self.queue.forget(number)

    def _advertise(self, channel: protocol.ClientChannel) -> None:
        reason = self._hub.rights().may_publish(channel.topic, channel.type_name)
        if channel.encoding != "cdr":
            reason = f"the encoding is cdr, not {channel.encoding!r}"
        elif channel.number in self._channels:
            reason = f"channel number {channel.number} is in use"
        elif (
            not reason
            and channel.schema_encoding != "ros2msg"
            and not self._hub.known(channel.topic, channel.type_name)
        ):
            reason = f"{channel.type_name} is no standard type: state its schema, with schemaEncoding ros2msg"
        elif len(self._channels) >= SUBSCRIPTIONS_MAX:
            reason = f"more than {SUBSCRIPTIONS_MAX} channels"
        elif sum(len(each.schema) for each in self._channels.values()) + len(channel.schema) > SCHEMAS_MAX:
            reason = f"the schemas of this client have more than {SCHEMAS_MAX} characters"
        if reason:
            self.tell_wrong(f"advertise {channel.topic}: {reason}")
            return
        self._channels[channel.number] = channel

    def _publish(self, message: protocol.PublishMessage, now_ns: int) -> None:
        channel = self._channels.get(message.channel)
        if channel is None:
            raise RemoteError(DropReason.MALFORMED, f"a message of channel {message.channel}, which is not advertised")
        self._hub.input(channel.topic, channel.type_name, now_ns, message.raw)

    def _call(self, message: protocol.CallService) -> None:
        call = _Call(message.service, message.call)
        reason = ""
        if message.service not in self._hub.services:
            reason = f"there is no service {message.service}"
        elif message.encoding != "cdr":
            reason = f"the encoding is cdr, not {message.encoding!r}"
        elif self._calls >= CALLS_MAX:
            reason = f"more than {CALLS_MAX} calls are under way"
        if reason:
            self.queue.put_control(protocol.service_failure(call.service, call.call, reason))
            return
        self._calls += 1
        self._hub.request(self, message.service, call, message.raw)
