"""Carriers of the traffic: a session of GDP's library, and a Zenoh peer over one link of TLS or QUIC.

I/O. Each is used as its users would: urgent streams have GDP's priority ``urgent``; with Zenoh they are express, at the
priority REAL_TIME, and bulk streams are at DATA_LOW.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import gdp
from gdp.runtime.busy_poll import SPIN_US
from gdp.runtime.memory_tuning import tune_memory
from thin_link.exchange import Arrival, Carrier
from thin_link.traffic import Stream

if TYPE_CHECKING:
    import zenoh

_PATIENCE_S: Final = 30.0
_QUEUE: Final = 4_096


class GdpCarrier:
    """Session of a member; ``readers``: how many each of its streams has. A thread hands over what arrives."""

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


class ZenohCarrier:
    """Session of a peer with mutual TLS.

    ``congestion``: ``drop`` (best-effort streams drop, reliable ones block, as rmw_zenoh sets it) or ``block`` (all
    block).
    """

    def __init__(self, settings: dict[str, Any], arrived: Arrival) -> None:
        import zenoh
        from peers.zenoh_endpoint import zenoh_config

        self._blocks_all = settings.pop("congestion") == "block"
        self._session = zenoh.open(zenoh_config("peer", **settings))
        self._arrived, self._control, self._priority = arrived, zenoh.CongestionControl, zenoh.Priority
        self._publishers: list[zenoh.Publisher] = []
        self._subscribers: list[zenoh.Subscriber[None]] = []

    def publish(self, stream: Stream) -> Callable[[bytes], None]:
        """Publish a stream, as ``Carrier``."""
        blocks = self._blocks_all or stream.reliable
        priority = self._priority.DATA_LOW if stream.bulk else self._priority.DATA
        publisher = self._session.declare_publisher(
            _key(stream),
            congestion_control=self._control.BLOCK if blocks else self._control.DROP,
            priority=self._priority.REAL_TIME if stream.urgent else priority,
            express=stream.urgent,
        )
        self._publishers.append(publisher)
        return publisher.put

    def subscribe(self, stream: Stream) -> None:
        """Read a stream, as ``Carrier``."""

        def take(sample: zenoh.Sample) -> None:
            """Hand over a message."""
            self._arrived(stream, sample.payload.to_bytes(), time.monotonic_ns())

        self._subscribers.append(self._session.declare_subscriber(_key(stream), take))

    def is_matched(self) -> bool:
        """Return whether every published stream is read."""
        return all(each.matching_status.matching for each in self._publishers)  # type: ignore[attr-defined]  # its stub


def _key(stream: Stream) -> str:
    return "robot/" + stream.name.replace(" ", "_")


CARRIERS: Final[Mapping[str, Callable[[dict[str, Any], Arrival], Carrier]]] = {"gdp": GdpCarrier, "zenoh": ZenohCarrier}
