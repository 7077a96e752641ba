"""Carrier of Zenoh: peers over one link of TLS or QUIC, with priorities and express as its users set them.

I/O. Urgent streams are express, at the priority REAL_TIME; bulk streams are at DATA_LOW. ``congestion`` is ``drop``
(best-effort streams drop, reliable ones block, as rmw_zenoh sets it) or ``block`` (all block).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import zenoh

from thin_link.carrier import Arrival
from thin_link.traffic import Stream


class ZenohCarrier:
    """Session of a peer."""

    def __init__(self, settings: dict[str, Any], arrived: Arrival) -> None:
        self._session = zenoh.open(_config(settings))
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


def _config(settings: dict[str, Any]) -> zenoh.Config:
    config: zenoh.Config = zenoh.Config()
    path = f"{settings['certificates']}/{settings['host']}"
    tls = {
        "root_ca_certificate": f"{settings['certificates']}/ca.crt",
        "enable_mtls": True,
        "verify_name_on_connect": True,
        **{f"{side}_private_key": f"{path}.key" for side in ("listen", "connect")},
        **{f"{side}_certificate": f"{path}.crt" for side in ("listen", "connect")},
    }
    values = {
        "mode": "peer",
        "transport/shared_memory/enabled": False,
        "scouting/multicast/enabled": False,
        "transport/link/tls": tls,
        "listen/endpoints": settings["listen"],
        "connect/endpoints": settings["connect"],
    }
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config
