"""Endpoint process of Cyclone DDS.

Process of its own, started by ``systems.py``.

Messages go in and out as serialised bytes, which is what a ROS 2 node passes to the middleware. The binding's own
serialiser, in Python, would cost 26 ms for an image. For that the type is one octet: Cyclone carries the rest of a
longer message along. Each endpoint waits by a WaitSet in the thread that continues the work. A listener would add a
change of threads.
"""

from __future__ import annotations

import os
import time
from collections import deque
from dataclasses import dataclass
from typing import Final

from cyclonedds._clayer import ddspy_take, ddspy_write
from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import uint8
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from peers.exchange import ANSWER, answer_to, ping
from peers.jsonl import Settings, run_role, say

_ANY: Final = SampleState.Any | ViewState.Any | InstanceState.Any
_AT_ONCE: Final = 16
_FOREVER_S: Final = 3_600.0
_PREFIX: Final = b"\x00\x01\x00\x00"  # of CDR: little-endian; the answer needs one


@dataclass
class Opaque(IdlStruct, typename="bench::Opaque"):  # type: ignore[call-arg, misc]
    """Any serialised message."""

    first: uint8


class CycloneWay:
    """One endpoint: writes one topic, reads the other."""

    def __init__(self, writes: str, reads: str, xml: str) -> None:
        os.environ["CYCLONEDDS_URI"] = xml  # read when the participant is made
        qos = Qos(
            Policy.Reliability.Reliable(max_blocking_time=10_000_000_000),
            Policy.History.KeepLast(10),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        participant = DomainParticipant(0)
        self._writer = DataWriter(participant, Topic(participant, writes, Opaque), qos=qos)
        self._reader = DataReader(participant, Topic(participant, reads, Opaque), qos=qos)
        self._waiting = WaitSet(participant)
        self._waiting.attach(ReadCondition(self._reader, _ANY))
        self._arrived = deque[bytes]()

    def send(self, message: bytes) -> None:
        """Send a message; it waits while the cache is full, and then refuses by ``OSError``."""
        if (result := ddspy_write(self._writer._ref, message)) < 0:
            raise OSError(f"Cyclone DDS does not write: {result}")

    def receive(self, deadline_s: float) -> bytes | None:
        """Return the next message; None when the monotonic second has passed."""
        while not self._arrived:
            rest_s = deadline_s - time.monotonic()
            if rest_s <= 0:
                return None
            self._waiting.wait(int(rest_s * 1e9))
            taken = ddspy_take(self._reader._ref, _ANY, _AT_ONCE)
            if not isinstance(taken, list):
                raise OSError(f"Cyclone DDS does not read: {taken}")
            self._arrived.extend(message for message, info in taken if info.valid_data)
        return self._arrived.popleft()

    def wait(self, deadline_s: float) -> bytes | None:
        """Return the next answer without its prefix; None when the monotonic second has passed."""
        message = self.receive(deadline_s)
        return None if message is None else message[len(_PREFIX) : len(_PREFIX) + ANSWER.size]


def _ping(settings: Settings) -> None:
    ping(CycloneWay("ping", "pong", settings["xml"]), settings)


def _pong(settings: Settings) -> None:
    way = CycloneWay("pong", "ping", settings["xml"])
    say(event="ready")
    while (message := way.receive(time.monotonic() + _FOREVER_S)) is not None:
        way.send(_PREFIX + answer_to(message))


if __name__ == "__main__":
    run_role({"ping": _ping, "pong": _pong})
