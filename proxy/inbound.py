"""Messages from the overlay on their way to a local endpoint: described, decoded, handed over, counted.

Place: shell; the endpoint does the I/O.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import Protocol

from gdp.client.member import Message
from gdp.errors import LocalError, RemoteError
from gdp.names import Name
from proxy.config import Rule
from proxy.node import ProxyNode
from proxy.parcel import Description, Parcel
from proxy.serial.channel import Channel
from proxy.serial.serializer import Serializer
from proxy.tally import Tally

__all__ = ["Inbound", "Sink"]

log = logging.getLogger(__name__)


class Sink(Protocol):
    """The half of an endpoint that takes messages."""

    def add(self, channel: Channel) -> int:
        """Return a handle for a channel; raises ``LocalError`` for one that it cannot take."""

    def write(self, handle: int, stamp_ns: int, raw: bytes) -> None:
        """Take one message."""


class _Source:
    """One publisher's description, made ready."""

    def __init__(self, description: Description, sink: Sink | None) -> None:
        self.serializers = [Serializer(channel, description.encoding) for channel in description.channels]
        self.handles = [None if sink is None else sink.add(channel) for channel in description.channels]


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
        self._sources: dict[tuple[Name, bytes, bytes], _Source | None] = {}

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
                log.warning("message of %s not handed over: %s", tally.topic, error)

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
        """Return what describes a message; a description is read once."""
        key = (message.topic, message.delivered.publisher, message.description)
        if key not in self._sources:
            self._sources[key] = None
            description = Description.from_wire(message.description)
            self._check(self._rules[message.topic], description)
            self._sources[key] = _Source(description, self._sink)
        return self._sources[key]

    @staticmethod
    def _check(rule: Rule, description: Description) -> None:
        for channel in description.channels:
            if channel.type_name != rule.type_name:
                raise LocalError(f"{rule.name} is {channel.type_name}, not {rule.type_name} as the rule says")
