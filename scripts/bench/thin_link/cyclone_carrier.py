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

from cyclonedds._clayer import ddspy_take, ddspy_write
from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from peers.cyclone_endpoint import Opaque

from thin_link.exchange import Arrival
from thin_link.traffic import Stream

_ANY: Final = SampleState.Any | ViewState.Any | InstanceState.Any
_PREFIX: Final = b"\x00\x01\x00\x00"  # of CDR: little-endian
_AT_ONCE: Final = 16
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
            """Write a message; a reliable writer waits while its cache is full, and then refuses."""
            if (result := ddspy_write(writer._ref, _PREFIX + message)) < 0:
                raise OSError(f"Cyclone DDS does not write: {result}")

        return send

    def subscribe(self, stream: Stream) -> None:
        """Read a stream, as ``Carrier``."""
        reader = DataReader(self._participant, self._topic(stream), qos=_qos(stream))
        threading.Thread(target=self._read, args=(stream, reader), daemon=True).start()

    def is_matched(self) -> bool:
        """Return whether every published stream is read."""
        return all(writer.get_matched_subscriptions() for writer in self._writers)

    def _read(self, stream: Stream, reader: Any) -> None:
        waiting = WaitSet(self._participant)
        waiting.attach(ReadCondition(reader, _ANY))
        while True:
            waiting.wait(_WAIT_NS)
            taken = ddspy_take(reader._ref, _ANY, _AT_ONCE)
            now_ns = time.monotonic_ns()
            for message, info in taken if isinstance(taken, list) else []:
                if info.valid_data:
                    self._arrived(stream, message[len(_PREFIX) :], now_ns)

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
