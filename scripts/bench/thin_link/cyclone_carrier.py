"""Carrier of Cyclone DDS: best-effort and reliable topics of opaque bytes, through whatever its interface secures.

I/O. A thread hands over what arrives. The transport priority of urgent streams is set, as its users can; it marks
packets, which a plain FIFO ignores.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from typing import Any, Final

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from peers.cyclone_endpoint import PREFIX, Opaque, take, waiting_for, write

from thin_link.exchange import Arrival
from thin_link.traffic import Stream

_BLOCKING_NS: Final = 10_000_000_000
_WAIT_NS: Final = 1_000_000_000
_URGENT: Final = 10


class CycloneCarrier:
    """One participant."""

    def __init__(self, settings: dict[str, Any], arrived: Arrival) -> None:
        os.environ["CYCLONEDDS_URI"] = settings["xml"]  # read when the participant is made
        self._participant = DomainParticipant(0)
        self._arrived = arrived
        self._writers: list[Any] = []

    def publish(self, stream: Stream) -> Callable[[bytes], None]:
        """Publish a stream, as ``Carrier``."""
        writer = DataWriter(self._participant, self._topic(stream), qos=_qos(stream))
        self._writers.append(writer)

        def send(message: bytes) -> None:
            write(writer, PREFIX + message)

        return send

    def subscribe(self, stream: Stream) -> None:
        """Read a stream, as ``Carrier``."""
        reader = DataReader(self._participant, self._topic(stream), qos=_qos(stream))
        threading.Thread(target=self._read, args=(stream, reader), daemon=True).start()

    def is_matched(self) -> bool:
        """Return whether every published stream is read."""
        return all(writer.get_matched_subscriptions() for writer in self._writers)

    def _read(self, stream: Stream, reader: Any) -> None:
        waiting = waiting_for(self._participant, reader)
        while True:
            waiting.wait(_WAIT_NS)
            taken, now_ns = take(reader), time.monotonic_ns()
            for message in taken:
                self._arrived(stream, message[len(PREFIX) :], now_ns)

    def _topic(self, stream: Stream) -> Any:
        return Topic(self._participant, stream.name.replace(" ", "_"), Opaque)


def _qos(stream: Stream) -> Any:
    return Qos(
        Policy.Reliability.Reliable(max_blocking_time=_BLOCKING_NS)
        if stream.reliable
        else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(100 if stream.urgent else 5),  # tf2; the sensor data profile of rmw
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.TransportPriority(_URGENT if stream.urgent else 0),
    )
