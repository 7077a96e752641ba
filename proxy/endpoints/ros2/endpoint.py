"""Endpoint ``ros2``: one virtual node in one domain, through rclpy.

I/O; called by the proxy's thread. A separate thread receives (``wait_thread``).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from typing import Final, cast

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import CallFailed, Event, Graph, Role
from proxy.endpoints.ros2.entities import ClientEntity, PublisherEntity, ServiceEntity, SubscriptionEntity
from proxy.endpoints.ros2.loopback_filter import LoopbackFilter
from proxy.endpoints.ros2.qos import conflict, filled, service_profile, to_profile
from proxy.endpoints.ros2.session import (
    ClientHandle,
    PublisherHandle,
    ServiceHandle,
    ServiceType,
    SubscriptionHandle,
    open_session,
    translated,
)
from proxy.endpoints.ros2.types import channel_of, class_of, service_of
from proxy.endpoints.ros2.wait_thread import WaitThread
from proxy.serial.channel import Channel, Qos, RosVersion, Service
from proxy.serial.standard_types import type_hash


class Ros2Endpoint:
    """A node of a ROS 2 graph.

    Args:
        domain: ROS domain id, 0 to 232.

    Raises:
        LocalError: ROS 2 is not installed, or does not start; the text states what to do.
    """

    ros: Final[RosVersion] = 2
    is_live: Final = True
    dropped: Final = 0  # messages wait in the middleware, which drops them by its QoS

    def __init__(self, domain: int, node: str) -> None:
        self.label = f"ros2 domain {domain}"
        self._session = open_session(domain, node)
        self._node = self._session.node
        self._waiting = WaitThread(self._session)
        self._numbers = 0
        self._subscription_entity: dict[int, SubscriptionEntity] = {}
        self._publisher_entity: dict[int, PublisherEntity] = {}
        self._serving: dict[int, ServiceEntity] = {}
        self._client_entity: dict[int, ClientEntity] = {}

    def fileno(self) -> int:
        """Return a descriptor that is readable while ``poll_events`` has events."""
        return self._waiting.fileno()

    def poll_events(self) -> Sequence[Event]:
        """Remove and return the pending events, in order."""
        return self._waiting.poll_events()

    def graph(self) -> Graph:
        """Return the last known graph."""
        return self._waiting.graph

    def channel(self, topic: str, type_name: str) -> Channel:
        """Return the installed description of a topic type; raises ``LocalError`` if there is none."""
        return channel_of(topic, type_name)

    def service(self, name: str, type_name: str) -> Service:
        """Return the installed description of a service type; raises ``LocalError`` if there is none."""
        return service_of(name, type_name)

    def subscribe(self, topic: str, type_name: str, qos: Qos | None) -> int:
        """Subscribe to a topic; raises ``LocalError`` for an unknown type or a refused name."""
        message = class_of(type_name)
        requested = filled(qos)
        channel = channel_of(topic, type_name)
        with translated(f"{topic}: cannot be subscribed to"):
            entity = self._node.create_subscription(
                message,
                topic,
                _ignore,
                to_profile(requested),
                callback_group=self._session.group(),
                raw=True,
                event_callbacks=self._session.silence(publisher=False),
            )
        handle = cast("SubscriptionHandle", entity.handle)
        subscription_entity = SubscriptionEntity(
            number=self._number(),
            topic=topic,
            message=message,
            qos=requested,
            channel=channel,
            entity=entity,
            handle=handle,
        )
        self._subscription_entity[subscription_entity.number] = subscription_entity
        self._tell_apart(topic)
        self._waiting.add(subscription_entity)
        return subscription_entity.number

    def advertise(self, channel: Channel) -> int:
        """Create a publisher; raises ``LocalError`` for an unknown or different type or a refused name."""
        known = self._checked(channel)
        offered = filled(channel.qos[0] if channel.qos else None, latched=channel.latched)
        with translated(f"{channel.topic}: cannot be advertised"):
            entity = self._node.create_publisher(
                class_of(channel.type_name),
                channel.topic,
                to_profile(offered),
                event_callbacks=self._session.silence(publisher=True),
            )
        handle = cast("PublisherHandle", entity.handle)
        publisher_entity = PublisherEntity(
            number=self._number(), topic=channel.topic, qos=offered, channel=known, entity=entity, handle=handle
        )
        if offered.durability == "transient_local":
            publisher_entity.kept = deque(maxlen=offered.depth)
        self._publisher_entity[publisher_entity.number] = publisher_entity
        self._tell_apart(channel.topic)
        self._waiting.add(publisher_entity)
        return publisher_entity.number

    def publish(self, handle: int, raw: bytes) -> None:
        """Publish one CDR message."""
        self._publisher_entity[handle].publish(raw)

    def subscribers(self, handle: int) -> int:
        """Return the present number of local subscriptions of a publisher, without the endpoint's own."""
        publisher_entity = self._publisher_entity[handle]
        ours = sum(
            subscription_entity.topic == publisher_entity.topic
            and not conflict(publisher_entity.qos, subscription_entity.qos)
            for subscription_entity in self._subscription_entity.values()
        )
        return max(0, publisher_entity.handle.get_subscription_count() - ours)

    def serve(self, service: Service) -> int:
        """Create a server; raises ``LocalError`` for an unknown or different type or a refused name."""
        known = service_of(service.name, service.type_name)
        if service.hash and known.hash and service.ros == 2 and service.hash != known.hash:
            raise LocalError(f"{service.name}: this machine has another definition of {service.type_name}")
        kind = class_of(service.type_name)
        with translated(f"{service.name}: cannot be served"):
            entity = self._node.create_service(
                kind, service.name, _ignore, qos_profile=service_profile(), callback_group=self._session.group()
            )
        serving = ServiceEntity(self._number(), cast("ServiceType", kind), entity, cast("ServiceHandle", entity.handle))
        self._serving[serving.number] = serving
        self._waiting.add(serving)
        return serving.number

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        """Answer a request; a response that cannot be read is replaced by a refusal."""
        from rclpy.serialization import deserialize_message

        serving = self._serving[handle]
        try:
            response = deserialize_message(raw, serving.response)
        except (RuntimeError, ValueError) as error:
            self.refuse(handle, ticket, f"a response that cannot be read: {error}")
            return
        serving.send(ticket, response)

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        """Answer {success: false, message: reason} where the response has these fields; ROS 2 has no other way."""
        serving = self._serving[handle]
        refusal = _refusal(serving.response, reason)
        if refusal is None:
            serving.forget(ticket)
        else:
            serving.send(ticket, refusal)

    def create_client(self, name: str, type_name: str) -> int:
        """Create a client; raises ``LocalError`` for an unknown type or a refused name."""
        service_of(name, type_name)
        kind = class_of(type_name)
        with translated(f"{name}: cannot be dialled"):
            entity = self._node.create_client(
                kind, name, qos_profile=service_profile(), callback_group=self._session.group()
            )
        handle = cast("ClientHandle", entity.handle)
        client_entity = ClientEntity(self._number(), name, cast("ServiceType", kind), entity, handle)
        self._client_entity[client_entity.number] = client_entity
        self._waiting.add(client_entity)
        return client_entity.number

    def call(self, handle: int, call: int, raw: bytes) -> None:
        """Send a request, or hold it until a server that the graph shows matches."""
        from rclpy.serialization import deserialize_message

        client_entity = self._client_entity[handle]
        try:
            request = deserialize_message(raw, client_entity.request)
        except (RuntimeError, ValueError) as error:
            self._waiting.add_event(CallFailed(handle, call, f"a request that cannot be read: {error}"))
            return
        is_there = any(end.role is Role.SERVES and end.name == client_entity.name for end in self.graph())
        failed = client_entity.begin(call, request, is_there=is_there, now_s=time.monotonic())
        if failed is not None:
            self._waiting.add_event(failed)
        elif client_entity.is_holding:
            self._waiting.wake()

    def drop(self, handle: int, call: int) -> None:
        """Forget a call."""
        self._client_entity[handle].drop(call)

    def close(self, handle: int) -> None:
        """Close a subscription, publisher, server or client."""
        self._waiting.remove(handle)
        if subscription_entity := self._subscription_entity.pop(handle, None):
            self._node.destroy_subscription(subscription_entity.entity)
            self._tell_apart(subscription_entity.topic)
        elif publisher_entity := self._publisher_entity.pop(handle, None):
            self._node.destroy_publisher(publisher_entity.entity)
        elif serving := self._serving.pop(handle, None):
            self._node.destroy_service(serving.entity)
        elif client_entity := self._client_entity.pop(handle, None):
            self._node.destroy_client(client_entity.entity)

    def shut_down(self) -> None:
        """Leave the graph and free everything."""
        self._waiting.close()
        self._session.close()

    def _number(self) -> int:
        self._numbers += 1
        return self._numbers

    def _checked(self, channel: Channel) -> Channel:
        """Return this machine's description of the channel's type, after verifying that it is equivalent."""
        known = channel_of(channel.topic, channel.type_name)
        if channel.ros != 2:
            raise LocalError(f"{channel.topic}: its messages are in ROS 1's form")
        theirs = channel.hash or type_hash(channel.type_name, channel.definition, channel.definition_format)
        if theirs and theirs != known.hash:
            raise LocalError(
                f"{channel.topic}: this machine has another definition of {channel.type_name} "
                f"({known.hash[:15]}, the publisher's is {theirs[:15]})"
            )
        return known

    def _tell_apart(self, topic: str) -> None:
        """Connect the endpoint's publishers of a topic to the loopback filters of its own subscriptions."""
        publisher_entity = [end for end in self._publisher_entity.values() if end.topic == topic]
        subscription_entity = [end for end in self._subscription_entity.values() if end.topic == topic]
        for ear in subscription_entity if publisher_entity else ():
            if ear.own is None:
                ear.own = LoopbackFilter()
                for raw in (raw for end in publisher_entity for raw in end.kept):
                    ear.own.add(raw, time.monotonic())
        echoes = tuple(ear.own for ear in subscription_entity if ear.own is not None)
        for end in publisher_entity:
            end.echoes = echoes


def _ignore(*_: object) -> None:
    """Ignore a callback that rclpy requires; the wait-set thread reads data before any callback could run."""


def _refusal(response: type, reason: str) -> object | None:
    fields = cast("dict[str, str]", getattr(response, "get_fields_and_field_types", dict)())
    if (fields.get("success"), fields.get("message")) != ("boolean", "string"):
        return None
    return cast("object", response(success=False, message=reason))
