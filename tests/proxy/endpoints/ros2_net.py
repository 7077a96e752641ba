"""ROS 2 domain on loopback for one test: an endpoint of ours, and real rclpy peers in child processes."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import pytest

from lab.process import until
from proxy.endpoints.core.endpoint import (
    CallFailed,
    EndpointError,
    Event,
    MessageReceived,
    RequestReceived,
    ResponseReceived,
    TypeResolved,
    proxy_node_name,
)
from proxy.endpoints.ros2 import Ros2Endpoint

DOMAIN = 100 + os.getpid() % 100
NODE = proxy_node_name("0123456789abcdef" * 4)
PATIENCE_S = 10.0
PEER = Path(__file__).with_name("ros2_peer.py")
_Found = TypeVar(
    "_Found", TypeResolved, MessageReceived, RequestReceived, ResponseReceived, CallFailed, EndpointError
)  # the events of a handle

# loopback, and no shared memory: it would cross network namespaces
CONFINED = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}


class Peer:
    """Real node elsewhere; ``ros2_peer`` lists its commands.

    Args:
        words: in front of the command, such as those of ``nsenter``.
        environment: in addition to that of this process.
        program: reads the commands.
        stderr: as of ``Popen``.
    """

    def __init__(
        self,
        name: str,
        words: Sequence[str] = (),
        environment: Mapping[str, str] = CONFINED,
        program: Path = PEER,
        stderr: int | None = None,
    ) -> None:
        self._process = subprocess.Popen(
            [*words, sys.executable, str(program), name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            env={**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), **environment},
        )

    def tell(self, line: str) -> object:
        """Return the value of an expression there; a line after ``!`` is executed."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(line.replace("\n", "\\n") + "\n")
        self._process.stdin.flush()
        answer: object = json.loads(self._process.stdout.readline())
        assert not str(answer).startswith("ERROR"), answer
        return answer

    def waits_for(self, line: str, wanted: object) -> None:
        """Wait until an expression there has a value."""
        until(lambda: self.tell(line) == wanted, lambda: f"{line} is {self.tell(line)!r}, not {wanted!r}", PATIENCE_S)

    def end(self, *, kill: bool = False) -> None:
        """Stop it; idempotent."""
        if kill:
            self._process.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None and not pipe.closed:
                pipe.close()
        try:
            self._process.wait(8)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Ears:
    """Poller that keeps an endpoint's events."""

    def __init__(self, endpoint: Ros2Endpoint) -> None:
        self.endpoint = endpoint
        self.events: list[Event] = []

    def until(self, is_met: Callable[[], object], what: str = "") -> None:
        """Poll events until a condition holds."""
        until(is_met, lambda: f"{what}; {self.events[-5:]}", PATIENCE_S, meanwhile=lambda: self._poll(0.02))

    def _poll(self, seconds: float) -> None:
        select.select([self.endpoint], [], [], seconds)
        self.events += self.endpoint.poll_events()

    def for_s(self, seconds: float) -> None:
        """Poll events for a time: for events that must not happen."""
        end = time.monotonic() + seconds
        while (rest := end - time.monotonic()) > 0:
            self._poll(rest)

    def of(self, kind: type[_Found], handle: int) -> list[_Found]:
        """Return the events of a kind of a handle so far."""
        return [event for event in self.events if isinstance(event, kind) and event.handle == handle]

    def heard(self, handle: int) -> list[bytes]:
        return [event.raw for event in self.of(MessageReceived, handle)]

    def next_asked(self, handle: int, count: int = 1) -> list[RequestReceived]:
        self.until(lambda: len(self.of(RequestReceived, handle)) >= count, "a request")
        return self.of(RequestReceived, handle)

    def outcome(self, handle: int, call: int) -> ResponseReceived | CallFailed:
        def found() -> list[ResponseReceived | CallFailed]:
            ends: list[ResponseReceived | CallFailed] = [
                *self.of(ResponseReceived, handle),
                *self.of(CallFailed, handle),
            ]
            return [event for event in ends if event.call == call]

        self.until(found, f"the outcome of call {call}")
        return found()[0]


def needs(*packages: str) -> None:
    """Skip where rclpy or an interface package is not installed."""
    for package in ("rclpy", *packages):
        pytest.importorskip(package, reason=f"{package} is not installed: pip install 'gdp-ros[ros2]', or source ROS 2")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of the parser that rosidl uses
        pytest.importorskip("rosidl_generator_py")


@contextmanager
def endpoint_of_ours(node: str = NODE) -> Iterator[Ears]:
    """Endpoint in the domain."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in CONFINED.items():
            patch.setenv(name, value)
        endpoint = Ros2Endpoint(DOMAIN, node)
        try:
            yield Ears(endpoint)
        finally:
            endpoint.shut_down()


@contextmanager
def peer_of(name: str, words: Sequence[str] = (), environment: Mapping[str, str] = CONFINED) -> Iterator[Peer]:
    """Real node in the domain."""
    peer = Peer(name, words, environment)
    try:
        yield peer
    finally:
        peer.end()
