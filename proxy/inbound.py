"""Messages from the overlay on their way to a local endpoint: described, decoded, handed over, counted.

Place: shell; the endpoint does the I/O. A message goes where its rule says; the topic that its publisher names is not
looked at. What publishers describe is kept within bounds, and each has a bounded number of channels at the sink.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, Protocol

from gdp.client.member import Message
from gdp.errors import LocalError, RemoteError
from gdp.names import Name
from proxy.config import Rule
from proxy.faults import Fault
from proxy.node import ProxyNode
from proxy.parcel import CHANNELS_MAX, Description, Parcel
from proxy.serial.channel import Channel
from proxy.serial.serializer import Serializer
from proxy.sources import Sources
from proxy.tally import Tally

__all__ = ["Inbound", "Sink"]

_PUBLISHERS_MAX: Final = 4_096  # whose channels at the sink are counted


class Sink(Protocol):
    """The half of an endpoint that takes messages."""

    def add(self, channel: Channel) -> int:
        """Return a handle for a channel; raises ``LocalError`` for one that it cannot take."""

    def write(self, handle: int, stamp_ns: int, raw: bytes) -> None:
        """Take one message."""


class _Source:
    """One publisher's description, made ready."""

    def __init__(self, description: Description, handles: Sequence[int | None]) -> None:
        self.serializers = [Serializer(channel, description.encoding) for channel in description.channels]
        self.handles = handles


class Inbound:
    """Takes what a member has received.

    Args:
        sink: where messages go; None: they are only counted.
    """

    def __init__(self, node: ProxyNode, rules: Sequence[Rule], sink: Sink | None) -> None:
        self._node = node
        self._sink = sink
        self._rules = {rule.overlay_name: rule for rule in rules}
        self.tallies = {name: Tally(rule.name, rule.type_name) for name, rule in self._rules.items()}
        self._sources = {name: Sources[_Source]() for name in self._rules}
        self._handles: dict[tuple[Name, bytes], set[int]] = {}  # of each publisher of each topic, at the sink

    @property
    def received(self) -> int:
        """Return how many messages came."""
        return sum(tally.received for tally in self.tallies.values())

    @property
    def lost(self) -> int:
        """Return how many messages are known to be lost."""
        self._count_losses()
        return sum(tally.lost for tally in self.tallies.values())

    def _count_losses(self) -> None:
        for name, tally in self.tallies.items():
            tally.losses = self._node.member.losses_of(name)

    def take(self) -> None:
        """Hand over what has arrived."""
        for message in self._node.member.take_messages():
            tally = self.tallies[message.topic]
            try:
                self._take(message, tally)
            except (LocalError, RemoteError) as error:
                tally.refused += 1
                fault = Fault.MALFORMED if isinstance(error, RemoteError) else Fault.REFUSED
                self._node.faults.tell(tally.topic, fault, f"a message was not handed over: {error}")

    def to_fields(self) -> list[dict[str, object]]:
        """Return the figures of every topic."""
        self._count_losses()
        return [tally.to_fields() for tally in self.tallies.values()]

    def _take(self, message: Message, tally: Tally) -> None:
        source = self._source(message)
        parcel = Parcel.from_wire(message.delivered.message)
        if source is None or parcel.channel >= len(source.serializers):
            raise LocalError("its description was refused")
        raw = source.serializers[parcel.channel].decode(parcel.body)
        handle = source.handles[parcel.channel]
        stamp_ns = time.time_ns()
        if handle is not None and self._sink is not None:
            self._sink.write(handle, stamp_ns, raw)
        latency_ms = (stamp_ns - parcel.stamp_ns) / 1e6
        delivered = message.delivered
        tally.count_number(delivered.publisher, delivered.incarnation, delivered.number, delivered.place)
        tally.add(latency_ms, delivered.parts, delivered.hops)
        self._node.traffic.latency.observe(latency_ms / 1e3)
        self._node.traffic.received(len(delivered.message))

    def _source(self, message: Message) -> _Source | None:
        """Return what describes a message, None where it was refused; a description is read once while it is kept."""
        sources, publisher = self._sources[message.topic], message.delivered.publisher
        if (publisher, message.description) not in sources:
            sources.put(publisher, message.description, None)
            rule = self._rules[message.topic]
            description = Description.from_wire(message.description)
            for channel in description.channels:
                if channel.type_name != rule.type_name:
                    raise LocalError(f"{rule.name} is {channel.type_name}, not {rule.type_name} as the rule says")
            handles = [self._add(message.topic, publisher, channel) for channel in description.channels]
            sources.put(publisher, message.description, _Source(description, handles))
        return sources.get(publisher, message.description)

    def _add(self, topic: Name, publisher: bytes, channel: Channel) -> int | None:
        """Return the sink's handle for a publisher's channel under the rule's own name."""
        if self._sink is None:
            return None
        known = self._handles.setdefault((topic, publisher), set())
        if len(self._handles) > _PUBLISHERS_MAX:
            del self._handles[next(iter(self._handles))]
        if len(known) >= CHANNELS_MAX:
            raise LocalError(f"its publisher has described more than {CHANNELS_MAX} channels")
        handle = self._sink.add(replace(channel, topic=self._rules[topic].local))
        known.add(handle)
        return handle
