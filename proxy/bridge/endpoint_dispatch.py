"""Endpoint dispatcher: delivers events of one endpoint to the owners of its handles."""

from __future__ import annotations

from typing import Protocol

from proxy.bridge.context import BridgeContext
from proxy.endpoints.core.endpoint import EndpointError, Event, GraphChanged, RosEndpoint
from proxy.serial.channel import Channel, Qos, Service


class EventHandler(Protocol):
    """Receiver of the events of a handle."""

    def handle_event(self, event: Event, now_s: float) -> None:
        """Process an event of one of its handles."""


class EndpointDispatcher:
    """Endpoint with the owners of its handles."""

    def __init__(self, endpoint: RosEndpoint) -> None:
        self.endpoint = endpoint
        self._owners: dict[int, tuple[str, EventHandler]] = {}  # with the local name
        self._faulted: list[EndpointError] = []

    def deliver(self, context: BridgeContext, now_s: float) -> bool:
        """Deliver all events except faults, each within the error boundary; return whether the graph changed."""
        is_changed = False
        for event in self.endpoint.poll_events():
            if isinstance(event, GraphChanged):
                is_changed = True
            elif isinstance(event, EndpointError):
                self._faulted.append(event)
            else:
                self._deliver(event, context, now_s)
        return is_changed

    def deliver_faults(self, context: BridgeContext, now_s: float) -> None:
        """Deliver faults after the graph in which they arose was processed; handles that gave way have no owner."""
        faulted, self._faulted = self._faulted, []
        for event in faulted:
            self._deliver(event, context, now_s)

    def subscribe(self, owner: EventHandler, topic: str, type_name: str, qos: Qos | None) -> int:
        """Subscribe to a topic, as ``RosEndpoint.subscribe``."""
        return self._own(self.endpoint.subscribe(topic, type_name, qos), topic, owner)

    def advertise(self, owner: EventHandler, channel: Channel) -> int:
        """Create a publisher, as ``RosEndpoint.advertise``."""
        return self._own(self.endpoint.advertise(channel), channel.topic, owner)

    def serve(self, owner: EventHandler, service: Service) -> int:
        """Create a server, as ``RosEndpoint.serve``."""
        return self._own(self.endpoint.serve(service), service.name, owner)

    def create_client(self, owner: EventHandler, name: str, type_name: str) -> int:
        """Create a client, as ``RosEndpoint.create_client``."""
        return self._own(self.endpoint.create_client(name, type_name), name, owner)

    def close(self, handle: int) -> None:
        """Close a handle."""
        if self._owners.pop(handle, None) is not None:
            self.endpoint.close(handle)

    def _own(self, handle: int, name: str, owner: EventHandler) -> int:
        self._owners[handle] = name, owner
        return handle

    def _deliver(self, event: Event, context: BridgeContext, now_s: float) -> None:
        if not isinstance(event, GraphChanged) and (found := self._owners.get(event.handle)) is not None:
            name, owner = found
            context.contain(name, b"", now_s, owner.handle_event, event, now_s)
