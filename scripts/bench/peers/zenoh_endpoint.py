"""Endpoint and router processes of Zenoh; the endpoints are as a user would write them (a callback and an Event).

Process of its own, started by ``zenoh_net.py``. Shared memory is off everywhere: it would cross namespaces of
one host, and its figures are not those of a network.
"""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections import deque
from typing import Final

import zenoh

from peers.exchange import answer_to, exchange
from peers.jsonl import EndSettings, say

_PING: Final = "bench/ping"
_PONG: Final = "bench/pong"


class ZenohWay:
    """A's side: publishes on one key, subscribes to the answers on another."""

    def __init__(self, session: zenoh.Session) -> None:
        self._answers = deque[bytes]()
        self._arrived = threading.Event()
        self._publisher = _publisher(session, _PING)
        self._subscriber = session.declare_subscriber(_PONG, self._take)

    def send(self, message: bytes) -> None:
        """Send a message."""
        self._publisher.put(message)

    def wait(self, deadline_s: float) -> bytes | None:
        """Return the next answer; None when the monotonic second has passed."""
        while not self._answers:
            if not self._arrived.wait(max(deadline_s - time.monotonic(), 0.0)):
                return None
            self._arrived.clear()
        return self._answers.popleft()

    def _take(self, sample: zenoh.Sample) -> None:
        self._answers.append(sample.payload.to_bytes())
        self._arrived.set()


def main() -> None:
    """Run ``ping``, ``pong`` or ``router``."""
    settings = EndSettings.from_argument()
    with zenoh.open(_config(settings)) as session:
        if settings.role == "ping":
            pids = {"sender": [os.getpid()], **settings.pids}
            say(series="zenoh", sizes=exchange(ZenohWay(session), settings.load, pids))
            return
        if settings.role == "pong":
            back = _publisher(session, _PONG)
            with session.declare_subscriber(_PING, lambda sample: back.put(answer_to(sample.payload.to_bytes()))):
                _serve()
        else:
            _serve()


def _serve() -> None:
    """Wait for the signal to end; Zenoh works in threads of its own."""
    say(event="ready")
    signal.sigwait({signal.SIGTERM, signal.SIGINT})


def _publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    return session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, express=True)


def _config(settings: EndSettings) -> zenoh.Config:
    own = settings.own
    config: zenoh.Config = zenoh.Config()

    def put(key: str, value: object) -> None:
        config.insert_json5(key, json.dumps(value))

    put("mode", "router" if settings.role == "router" else "client")
    put("transport/shared_memory/enabled", False)
    put("scouting/multicast/enabled", False)
    if "listen" in own:
        put("listen/endpoints", [own["listen"]])
    if "connect" in own:
        put("connect/endpoints", [own["connect"]])
    if "certificates" in own:
        path = f"{own['certificates']}/{own['host']}"
        put(
            "transport/link/tls",
            {
                "root_ca_certificate": f"{own['certificates']}/ca.crt",
                "enable_mtls": True,
                "verify_name_on_connect": True,
                **{f"{side}_private_key": f"{path}.key" for side in ("listen", "connect")},
                **{f"{side}_certificate": f"{path}.crt" for side in ("listen", "connect")},
            },
        )
    return config


if __name__ == "__main__":
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGINT})  # for sigwait; threads inherit it
    main()
