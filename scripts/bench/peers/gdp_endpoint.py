"""Endpoint process of GDP at A and B: a session of the library, or client and server under a session secret.

Process of its own, started by ``systems.py``. Each message is encrypted, authenticated, ordered and acknowledged. That
is all that a proxy does except for ROS.
"""

from __future__ import annotations

import signal
import time
from collections import deque
from pathlib import Path
from typing import Final

import gdp
from gdp.names import Name
from gdp.runtime.busy_poll import SPIN_US
from gdp.runtime.memory_tuning import tune_memory
from lab.end import End
from peers.exchange import PATIENCE_S, answer_to, ping
from peers.jsonl import Settings, run_role, say

PING, PONG = "/ping", "/pong"
_FOREVER_S: Final = 3_600.0


class SignedEndpoint:
    """Session of the library: publishes one topic and reads the other; signatures authenticate."""

    def __init__(self, config: Path, *, is_ping: bool) -> None:
        self._session = gdp.open(config, busy_poll_us=SPIN_US, timeout_s=PATIENCE_S)
        self._publisher = self._session.publisher(PING if is_ping else PONG, reliable=True)
        self._subscription = self._session.subscribe(PONG if is_ping else PING)

    def connect(self) -> None:
        """Wait until the published topic is read; raises ``gdp.SessionError``: it is not."""
        self._publisher.wait_for_readers(timeout_s=PATIENCE_S)

    def send(self, message: bytes) -> None:
        """Send a message."""
        self._publisher.put(message)

    def wait(self, deadline_s: float) -> bytes | None:
        """Return the next message; None when the monotonic second has passed."""
        try:
            return self._subscription.receive(deadline_s - time.monotonic()).payload
        except gdp.SessionTimeoutError:
            return None


class SessionEndpoint:
    """Client or server of a name under ``sign: session``: a message is a request, and an answer its response."""

    def __init__(self, config: Path, *, is_ping: bool) -> None:
        self._end = End.from_config(config, SPIN_US / 1e6)
        self._is_client = is_ping
        if is_ping:
            self._end.call(PING, is_session=True)
        else:
            self._end.serve(PING, is_session=True)
        self._services, self._name = self._end.member.services, self._end.name_of(PING)
        self._arrived = deque[bytes]()
        self._client: Name | None = None  # of the newest request

    def connect(self) -> None:
        """Wait until the name has a server; raises ``TimeoutError``."""
        if not self._end.runtime.run(lambda: bool(self._services.peers(self._name)), time.monotonic() + PATIENCE_S):
            raise TimeoutError("no server: the overlay did not come up")

    def send(self, message: bytes) -> None:
        """Send a request to the only server, or respond to the newest one."""
        if self._is_client:
            (server,) = self._services.peers(self._name)
            self._services.send_request(self._name, server, message)
        elif self._client is not None:
            self._services.respond(self._name, self._client, message)
        self._end.member.flush(time.monotonic())
        self._end.runtime.send()

    def wait(self, deadline_s: float) -> bytes | None:
        """Return the next request or response; None when the monotonic second has passed."""
        while not self._arrived:
            if time.monotonic() >= deadline_s:
                return None
            self._end.runtime.step(deadline_s)
            for each in self._end.member.poll_messages():
                self._client = Name(each.delivered.publisher)
                self._arrived.append(each.delivered.message)
        return self._arrived.popleft()


def _end(settings: Settings, *, is_ping: bool) -> SessionEndpoint | SignedEndpoint:
    kind = SessionEndpoint if settings["sign"] == "session" else SignedEndpoint
    end = kind(Path(settings["config"]), is_ping=is_ping)
    tune_memory()
    return end


def _ping(settings: Settings) -> None:
    end = _end(settings, is_ping=True)
    end.connect()
    ping(end, settings)


def _pong(settings: Settings) -> None:
    end = _end(settings, is_ping=False)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # the bench ends it so; there is nothing to release
    say(event="ready")
    while True:
        if message := end.wait(time.monotonic() + _FOREVER_S):
            end.send(answer_to(message))


if __name__ == "__main__":
    run_role({"ping": _ping, "pong": _pong})
