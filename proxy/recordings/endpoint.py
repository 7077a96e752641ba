"""Endpoints of a recording: one plays its messages to a bridge, one records what a bridge publishes.

I/O, through ``reader`` and ``writer``. Both implement ``proxy/endpoints/core/endpoint.py``, and hold topics only. A
recording distinguishes publishers: each has a channel. The caller owns the time: a message becomes an event when
``deliver`` is called with it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, NoReturn

from gdp.errors import LocalError
from proxy.endpoints.core.endpoint import (
    Graph,
    GraphChanged,
    GraphEntity,
    MessageReceived,
    Origin,
    Role,
    TypeResolved,
)
from proxy.endpoints.in_process import InProcessEndpoint
from proxy.serial.channel import Channel, Qos, RosVersion, Service

if TYPE_CHECKING:  # what records loads nothing that reads, and the reverse
    from proxy.recordings.reader import BagReader
    from proxy.recordings.split import SplitWriter
    from proxy.recordings.writer import BagWriter


class _TopicsEndpoint(InProcessEndpoint):
    """Common part of both endpoints: no services."""

    kind = "a recording"
    is_live = False

    def __init__(self, label: str) -> None:
        super().__init__()
        self.label = label
        self._put(GraphChanged())

    def channel(self, topic: str, type_name: str) -> Channel:
        """Refuse: a recording has its own definitions and no installed types. Raises ``LocalError``: always."""
        raise LocalError(f"{self.label}: {topic}: its messages bring the definition of {type_name}")

    def service(self, name: str, type_name: str) -> Service:
        """Refuse: a recording holds topics only; raises ``LocalError``."""
        del type_name
        self._refuse(name)

    def serve(self, service: Service) -> int:
        """Refuse: a recording holds topics only; raises ``LocalError``."""
        self._refuse(service.name)

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        """Ignore the answer: no client sent a request."""

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        """Ignore the refusal: no client sent a request."""

    def create_client(self, name: str, type_name: str) -> int:
        """Refuse: a recording holds topics only; raises ``LocalError``."""
        del type_name
        self._refuse(name)

    def _refuse(self, what: str) -> NoReturn:
        raise LocalError(f"{self.label}: {what}: a recording holds topics only")


class ReplayEndpoint(_TopicsEndpoint):
    """The publishers of a recording; ``reader``: open; its owner closes it."""

    def __init__(self, reader: BagReader) -> None:
        super().__init__(f"recording {reader.path}")
        self._reader = reader
        self._numbers = 0
        self._indexes: dict[tuple[str, str], list[int]] = {}  # of channels, by topic and type
        for index, channel in enumerate(reader.channels):
            self._indexes.setdefault((channel.topic, channel.type_name), []).append(index)
        self._subscribed: dict[int, tuple[int, int]] = {}  # by channel index: handle, number within the topic

    @property
    def ros(self) -> RosVersion:
        """Return the ROS version of its messages."""
        return self._reader.channels[0].ros if self._reader.channels else 2

    def graph(self) -> Graph:
        """Return one publisher for each channel, without its node: the recorded node need not exist now."""
        channels = enumerate(self._reader.channels)
        return frozenset(
            GraphEntity(Role.PUBLISHES, each.topic, each.type_name, "", str(index), hash=each.hash)
            for index, each in channels
        )

    def channels_of(self, topic: str, type_name: str) -> list[int]:
        """Return the indexes of a topic's channels; a channel's position here is its number within the topic."""
        return self._indexes.get((topic, type_name), [])

    def is_subscribed(self, index: int) -> bool:
        """Return whether a channel of the recording has a subscription."""
        return index in self._subscribed

    def subscribe(self, topic: str, type_name: str, qos: Qos | None) -> int:
        """Subscribe to a topic. Raises ``LocalError``: the recording does not have it."""
        del qos
        indexes = self.channels_of(topic, type_name)
        if not indexes:
            raise LocalError(f"{self.label}: it has no topic {topic} of type {type_name}")
        self._numbers += 1
        for number, index in enumerate(indexes):
            self._subscribed[index] = self._numbers, number
        first, *others = (self._reader.channels[index] for index in indexes)
        self._put(TypeResolved(self._numbers, first, tuple(others)))
        return self._numbers

    def messages(self, waiting: Callable[[], bool] | None = None) -> Iterator[MessageReceived]:
        """Yield the messages of subscribed topics in time order, with their recorded stamps.

        ``waiting``: as for ``BagReader.messages``.
        """
        for message in self._reader.messages(waiting):
            subscribed = self._subscribed.get(message.channel)
            if subscribed is not None:
                handle, number = subscribed
                yield MessageReceived(handle, message.stamp_ns, message.raw, number)

    def deliver(self, message: MessageReceived) -> None:
        """Publish a message now; its stamp is the present time."""
        self._put(message._replace(stamp_ns=time.time_ns()))

    def advertise(self, channel: Channel) -> int:
        """Refuse to publish; raises ``LocalError``."""
        raise LocalError(f"{self.label}: {channel.topic}: a recording that is replayed takes no messages")

    def publish(self, handle: int, raw: bytes) -> None:
        """Refuse to publish; raises ``LocalError``."""
        del raw
        raise LocalError(f"{self.label}: handle {handle}: a recording that is replayed takes no messages")

    def close(self, handle: int) -> None:
        """Close a subscription."""
        self._subscribed = {index: each for index, each in self._subscribed.items() if each[0] != handle}


class RecordingEndpoint(_TopicsEndpoint):
    """The subscriber of everything that is recorded.

    Equal channels share a handle, which stays valid: a recording has channels, not publishers.

    Args:
        writer: open; its owner closes it. None: messages are only counted.
        topics: local name and type of each topic that is recorded.
    """

    def __init__(self, writer: BagWriter | SplitWriter | None, topics: Sequence[tuple[str, str]]) -> None:
        super().__init__("messages that are counted" if writer is None else f"recording {writer.path}")
        self._writer = writer
        self._graph: Graph = frozenset(
            GraphEntity(Role.SUBSCRIBES, topic, type_name, "", str(index))
            for index, (topic, type_name) in enumerate(topics)
        )

    @property
    def ros(self) -> RosVersion:
        """Return the ROS version of the messages that it accepts."""
        return 2 if self._writer is None else self._writer.ros

    def graph(self) -> Graph:
        """Return a subscriber for each topic that is recorded."""
        return self._graph

    def subscribe(self, topic: str, type_name: str, qos: Qos | None) -> int:
        """Refuse to subscribe; raises ``LocalError``."""
        del type_name, qos
        raise LocalError(f"{self.label}: {topic}: a recording that is made has no messages to take")

    def advertise(self, channel: Channel) -> int:
        """Add a channel to the recording.

        Raises:
            LocalError: a channel of the other ROS, one that the format cannot hold, or one too many.
        """
        return 0 if self._writer is None else self._writer.add(channel)

    def publish(self, handle: int, raw: bytes) -> None:
        """Refuse a message without its origin; raises ``LocalError``."""
        del raw
        raise LocalError(f"{self.label}: handle {handle}: a recording takes messages of far publishers only")

    def record(self, handle: int, raw: bytes, origin: Origin) -> None:
        """Record one message with the present time as its stamp."""
        if self._writer is not None:
            self._writer.write(handle, time.time_ns(), raw, origin)

    def close(self, handle: int) -> None:
        """Do nothing: recorded messages stay."""
