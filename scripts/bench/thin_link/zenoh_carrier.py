"""Carrier of Zenoh: peers over one link of TLS or QUIC, with priorities and express as its users set them.

I/O. Urgent streams are express, at the priority REAL_TIME; bulk streams are at DATA_LOW. ``congestion`` is ``drop``
(best-effort streams drop, reliable ones block, as rmw_zenoh sets it) or ``block`` (all block).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import zenoh
from peers.zenoh_endpoint import zenoh_config

from thin_link.exchange import Arrival
from thin_link.traffic import Stream


class ZenohCarrier:
    """Session of a peer."""

    def __init__(self, settings: dict[str, Any], arrived: Arrival) -> None:
        config = zenoh_config(
            "peer", listen=settings["listen"], connect=settings["connect"], certificate=settings["certificate"]
        )
        self._session = zenoh.open(config)
        self._arrived = arrived
        self._blocks_all = settings["congestion"] == "block"
        self._publishers: list[zenoh.Publisher] = []
        self._subscribers: list[zenoh.Subscriber[None]] = []

    def publish(self, stream: Stream) -> Callable[[bytes], None]:
        """Publish a stream, as ``Carrier``."""
        control = zenoh.CongestionControl
        blocks = self._blocks_all or stream.reliable
        priority = zenoh.Priority.DATA_LOW if stream.bulk else zenoh.Priority.DATA
        publisher = self._session.declare_publisher(
            _key(stream),
            congestion_control=control.BLOCK if blocks else control.DROP,
            priority=zenoh.Priority.REAL_TIME if stream.urgent else priority,
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
