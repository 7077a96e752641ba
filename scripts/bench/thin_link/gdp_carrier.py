"""Carrier of GDP: a session of the library; urgent streams have the priority ``urgent``.

I/O. A thread hands over what arrives.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import gdp
from gdp.runtime.busy_poll import SPIN_US
from gdp.runtime.memory_tuning import tune_memory
from thin_link.exchange import Arrival
from thin_link.traffic import Stream

_PATIENCE_S: Final = 30.0
_QUEUE: Final = 4_096


class GdpCarrier:
    """Session of a member; ``readers``: how many each of its streams has."""

    def __init__(self, settings: dict[str, Any], arrived: Arrival) -> None:
        self._session = gdp.open(Path(settings["config"]), busy_poll_us=SPIN_US, timeout_s=_PATIENCE_S)
        self._arrived = arrived
        self._readers = int(settings.get("readers", 1))
        self._publishers: list[gdp.Publisher] = []
        tune_memory()

    def publish(self, stream: Stream) -> Callable[[bytes], None]:
        """Publish a stream, as ``Carrier``."""
        publisher = self._session.publisher(
            stream.name,
            reliable=stream.reliable,
            priority="urgent" if stream.urgent else "normal",
            own_pace=stream.own_pace,
        )
        self._publishers.append(publisher)
        return publisher.put

    def subscribe(self, stream: Stream) -> None:
        """Read a stream, as ``Carrier``."""
        subscription = self._session.subscribe(stream.name, queue=_QUEUE)
        threading.Thread(target=self._read, args=(stream, subscription), daemon=True).start()

    def is_matched(self) -> bool:
        """Return whether every published stream is read."""
        return all(publisher.readers >= self._readers for publisher in self._publishers)

    def _read(self, stream: Stream, subscription: gdp.Subscription) -> None:
        for message in subscription:
            self._arrived(stream, message.payload, time.monotonic_ns())
