"""Server of a node for scrapes and probes, on the loopback address, where every local user may connect.

I/O. Responses per second are bounded too, for each one reads the whole node.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import Final

from gdp.http_server import Answer, HttpServer
from gdp.intervals import CONNECT_S, Rate
from gdp.telemetry.health import PROBES, Health, probe
from gdp.token_bucket import TokenBucket

__all__ = ["scrape_server"]

_CONNECTIONS_MAX: Final = 4
_BACKLOG: Final = 128
_ANSWERS_RATE: Final = Rate(20.0, burst=20.0)  # a few ms each; a scraper polls every few seconds
_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
_JSON: Final = "application/json"


def scrape_server(port: int, text: Callable[[], bytes], health: Callable[[], Health] | None = None) -> HttpServer:
    """Serve the present text; the paths of ``PROBES`` give the state of the node instead.

    Args:
        port: of 127.0.0.1; 0: the system chooses.
        text: called in the server's thread, once for each response.
        health: called for each probe; None: the node has no probes, and they get 404.

    Raises:
        OSError: the port is in use.
    """
    answers = TokenBucket(*_ANSWERS_RATE)

    def answer(path: str) -> Answer:
        """Return the response for a path."""
        if not answers.spend(time.monotonic()):
            return Answer("503 Service Unavailable")
        if path not in PROBES:
            return Answer("200 OK", text(), _TYPE)
        if health is None:
            return Answer("404 Not Found")
        is_good, state = probe(path, health(), time.monotonic())
        return Answer("200 OK" if is_good else "503 Service Unavailable", state, _JSON)

    listener = socket.create_server(("127.0.0.1", port), backlog=_BACKLOG)
    return HttpServer(listener, answer, name="metrics", connections=_CONNECTIONS_MAX, timeout_s=CONNECT_S)
