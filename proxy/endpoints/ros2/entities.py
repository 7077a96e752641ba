"""Entities of the endpoint in the graph: subscriptions, publishers, servers and clients.

I/O through rclpy's handles. The wait-set thread calls ``drain``; the endpoint's caller calls everything else. A drain
reads a bounded number, so that one busy topic does not delay the others.
"""

from __future__ import annotations

import time
import warnings
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from threading import Lock
from typing import Final, Literal, Protocol, TypeAlias

from proxy.endpoints.core.endpoint import (
    CallFailed,
    Event,
    Graph,
    MessageReceived,
    RequestReceived,
    ResponseReceived,
    Role,
)
from proxy.endpoints.ros2.loopback_filter import LoopbackFilter
from proxy.endpoints.ros2.session import (
    ClientHandle,
    Handle,
    PublisherHandle,
    RequestId,
    ServiceHandle,
    ServiceType,
    SubscriptionHandle,
    WaitSet,
)
from proxy.serial.channel import Channel, Qos

Kind: TypeAlias = Literal["subscription", "service", "client"]

_AT_ONCE: Final = 64
_WARNING: Final = Lock()  # a record of warnings is one of the process
_TICKETS_MAX: Final = 10_000
_WINDOW: Final = 8  # less than the ten slots of a server's queue
_WINDOW_S: Final = 0.1
_PATIENCE_S: Final = 1.0  # time for a server that the graph shows to match a new client


class Source(Protocol):
    """An entity on which the wait-set thread waits."""

    @property
    def number(self) -> int:
        """Return the handle of the entity at the endpoint."""

    @property
    def kind(self) -> Kind:
        """Return the kind of entity in a wait set."""

    @property
    def handle(self) -> Handle:
        """Return rcl's object."""

    def join(self, wait_set: WaitSet) -> Callable[[], object]:
        """Return the callable that adds this entity to a wait set for one wait."""

    def poll_events(self) -> list[Event]:
        """Read the available data."""


@dataclass(slots=True, kw_only=True)
class SubscriptionEntity:
    """A subscription."""

    number: int
    topic: str
    message: type
    qos: Qos
    channel: Channel  # as far as the graph shows it
    handle: SubscriptionHandle
    own: LoopbackFilter | None = None  # set where this endpoint publishes the topic too
    described: Channel | None = None

    kind: Kind = "subscription"

    def join(self, wait_set: WaitSet) -> Callable[[], object]:
        """Return the callable that adds the subscription to a wait set."""
        return partial(wait_set.add_subscription, self.handle)

    def poll_events(self) -> list[Event]:
        """Read a bounded number of messages; the endpoint's own are left out."""
        events: list[Event] = []
        stamp_ns = time.time_ns()
        for _ in range(_AT_ONCE):
            taken = self.handle.take_message(self.message, True)
            if taken is None:
                break
            if self.own is None or not self.own.is_loopback(taken[0], time.monotonic()):
                events.append(MessageReceived(self.number, stamp_ns, taken[0]))
        return events

    def describe(self, graph: Graph) -> Channel:
        """Return the channel with the QoS that its present publishers offer."""
        offers = {end.qos for end in graph if end.role is Role.PUBLISHES and end.qos is not None}
        ordered = tuple(sorted(offers, key=repr))
        latched = any(qos.durability == "transient_local" for qos in ordered)
        return replace(self.channel, qos=ordered, latched=latched)


@dataclass(slots=True, kw_only=True)
class PublisherEntity:
    """A publisher; ``kept`` are messages for late joiners of a transient local one.

    A late joiner may be a subscription of the endpoint itself.
    """

    number: int
    topic: str
    qos: Qos
    channel: Channel
    handle: PublisherHandle
    kept: deque[bytes] = field(default_factory=lambda: deque(maxlen=0))
    echoes: tuple[LoopbackFilter, ...] = ()  # of the endpoint's own subscriptions to the topic

    def publish(self, raw: bytes) -> None:
        """Publish; the endpoint's own subscriptions filter the message out."""
        for own in self.echoes:
            own.add(raw, time.monotonic())
        self.kept.append(raw)
        self.handle.publish_raw(raw)


class ServiceEntity:
    """A virtual server; requests wait by ticket, and the oldest is dropped when there are too many."""

    kind: Final[Kind] = "service"

    def __init__(self, number: int, service: ServiceType, handle: ServiceHandle) -> None:
        self.number = number
        self.handle = handle
        self._request = service.Request
        self.response = service.Response
        self._tickets: OrderedDict[int, RequestId] = OrderedDict()
        self._next = 1
        self._late: deque[tuple[object, RequestId, float]] = deque()  # not sent yet, and until when each may be
        self._lock = Lock()

    def join(self, wait_set: WaitSet) -> Callable[[], object]:
        """Return the callable that adds the server to a wait set."""
        return partial(wait_set.add_service, self.handle)

    def poll_events(self) -> list[Event]:
        """Read a bounded number of requests."""
        from rclpy.serialization import serialize_message

        events: list[Event] = []
        for _ in range(_AT_ONCE):
            request, info = self.handle.service_take_request(self._request)
            if info is None:
                break
            with self._lock:
                ticket, self._next = self._next, self._next + 1
                self._tickets[ticket] = info.request_id
                if len(self._tickets) > _TICKETS_MAX:
                    self._tickets.popitem(last=False)
            events.append(RequestReceived(self.number, ticket, serialize_message(request)))
        return events

    def send(self, ticket: int, response: object) -> None:
        """Answer a request; an unknown ticket is ignored."""
        with self._lock:
            request = self._tickets.pop(ticket, None)
        if request is not None:
            self._send(response, request, time.monotonic() + _PATIENCE_S)

    def tend(self, now_s: float) -> None:
        """Send again what clients could not get that had not discovered this server."""
        for _ in range(len(self._late)):
            response, request, until_s = self._late.popleft()
            if now_s < until_s:
                self._send(response, request, until_s)

    def _send(self, response: object, request: RequestId, until_s: float) -> None:
        """Send a response; where its client does not match this server yet, rclpy only warns and drops it."""
        with _WARNING, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            self.handle.service_send_response(response, request)
        if caught:
            self._late.append((response, request, until_s))

    def forget(self, ticket: int) -> None:
        """Leave a request unanswered."""
        with self._lock:
            self._tickets.pop(ticket, None)


@dataclass(frozen=True, slots=True)
class _Held:
    """A call that is not sent yet."""

    request: object
    until_s: float  # deadline for a server that the graph shows to match this client


class ClientEntity:
    """A client; any number of its calls may be under way.

    A server's queue has ten slots by default, and drops the oldest request beyond that. So only a few unanswered
    requests are sent in a short time; the others are held.
    """

    kind: Final[Kind] = "client"

    def __init__(self, number: int, name: str, service: ServiceType, handle: ClientHandle) -> None:
        self.number = number
        self.name = name
        self.handle = handle
        self.request = service.Request
        self._response = service.Response
        self._lock = Lock()  # it covers sending too: a response may arrive before send_request returns
        self._calls: dict[int, int] = {}  # rcl's sequence number -> the caller's number
        self._recent: dict[int, float] = {}  # rcl's sequence number -> when the server has presumably read its request
        self._held: dict[int, _Held] = {}

    def join(self, wait_set: WaitSet) -> Callable[[], object]:
        """Return the callable that adds the client to a wait set."""
        return partial(wait_set.add_client, self.handle)

    def poll_events(self) -> list[Event]:
        """Read a bounded number of responses."""
        from rclpy.serialization import serialize_message

        events: list[Event] = []
        for _ in range(_AT_ONCE):
            info, response = self.handle.take_response(self._response)
            if info is None:
                break
            with self._lock:
                self._recent.pop(info.request_id.sequence_number, None)
                call = self._calls.pop(info.request_id.sequence_number, None)
            if call is not None:
                events.append(ResponseReceived(self.number, call, serialize_message(response)))
        self._send(time.monotonic())
        return events

    def begin(self, call: int, request: object, *, is_there: bool, now_s: float) -> CallFailed | None:
        """Send a request, or hold it briefly.

        Args:
            is_there: the graph shows a server, so that waiting for it to match this client is useful.
        """
        is_matched = self.handle.service_server_is_available()
        if not is_matched and not is_there:
            return CallFailed(self.number, call, f"no server of {self.name}")
        with self._lock:
            self._held[call] = _Held(request, now_s + _PATIENCE_S)
        if is_matched:
            self._send(now_s)
        return None

    def drop(self, call: int) -> None:
        """Forget a call."""
        with self._lock:
            self._held.pop(call, None)
            for sequence, known in self._calls.items():
                if known == call:
                    del self._calls[sequence]
                    break

    @property
    def is_holding(self) -> bool:
        """Return whether a call is not sent yet."""
        return bool(self._held)

    def tend(self, now_s: float) -> list[Event]:
        """Send held requests, and fail calls that cannot be answered any more."""
        if not self._held and not self._calls:
            return []
        if self.handle.service_server_is_available():
            self._send(now_s)
            return []
        with self._lock:
            late = [call for call, held in self._held.items() if held.until_s <= now_s]
            gone = [*self._calls.values(), *late]
            self._calls.clear()
            self._recent.clear()
            for call in late:
                del self._held[call]
        return [CallFailed(self.number, call, f"the server of {self.name} is gone") for call in gone]

    def _send(self, now_s: float) -> None:
        with self._lock:
            if self._held and len(self._recent) >= _WINDOW:
                self._recent = {sequence: until for sequence, until in self._recent.items() if until > now_s}
            while self._held and len(self._recent) < _WINDOW:
                call = next(iter(self._held))
                sequence = self.handle.send_request(self._held.pop(call).request)
                self._calls[sequence] = call
                self._recent[sequence] = now_s + _WINDOW_S
