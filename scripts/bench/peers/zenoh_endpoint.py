"""Endpoint and router processes of Zenoh; the endpoints are as a user would write them (a callback and an Event).

Process of its own, started by ``systems.py``. Shared memory is off: it would cross namespaces of one host.
"""

from __future__ import annotations

import json
import signal
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Final

import zenoh

from peers.exchange import answer_to, ping
from peers.jsonl import Settings, run_role, say


def zenoh_config(
    mode: str, *, listen: Sequence[str] = (), connect: Sequence[str] = (), certificate: str | None = None
) -> zenoh.Config:
    """Return the configuration of a router, client or peer.

    ``certificate``: path without its ending, of a host of ``make_certificates``; None: no TLS.
    """
    config: zenoh.Config = zenoh.Config()
    values: dict[str, object] = {
        "mode": mode,
        "transport/shared_memory/enabled": False,
        "scouting/multicast/enabled": False,
    }
    if listen:
        values["listen/endpoints"] = list(listen)
    if connect:
        values["connect/endpoints"] = list(connect)
    if certificate is not None:
        values["transport/link/tls"] = {
            "root_ca_certificate": f"{certificate.rpartition('/')[0]}/ca.crt",
            "enable_mtls": True,
            "verify_name_on_connect": True,
            **{f"{side}_private_key": f"{certificate}.key" for side in ("listen", "connect")},
            **{f"{side}_certificate": f"{certificate}.crt" for side in ("listen", "connect")},
        }
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


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


def _ping(settings: Settings) -> None:
    with zenoh.open(zenoh_config("client", **settings["own"])) as session:
        ping(ZenohWay(session), settings)


def _pong(settings: Settings) -> None:
    with zenoh.open(zenoh_config("client", **settings["own"])) as session:
        back = _publisher(session, _PONG)
        with session.declare_subscriber(_PING, lambda sample: back.put(answer_to(sample.payload.to_bytes()))):
            _serve()


def _route(settings: Settings) -> None:
    with zenoh.open(zenoh_config("router", **settings["own"])):
        _serve()


def _serve() -> None:
    """Wait for the signal to end; Zenoh works in threads of its own."""
    say(event="ready")
    signal.sigwait({signal.SIGTERM, signal.SIGINT})


def _publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    return session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, express=True)


if __name__ == "__main__":
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGINT})  # for sigwait; threads inherit it
    run_role({"ping": _ping, "pong": _pong, "router": _route})
