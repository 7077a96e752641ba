"""ROS 1 master on loopback with real rospy nodes, and an endpoint whose events are awaited, never slept for.

Master, nodes and the endpoints' rospy processes are forked from one zygote, which has imported rospy.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TypeVar
from unittest import mock

import pytest

from gdp.errors import LocalError
from lab import zygote
from lab.process import until
from proxy.endpoints.core.endpoint import Event
from proxy.endpoints.ros1 import Ros1Endpoint
from proxy.endpoints.ros1.install import rospy_folder

NODE = "gdp_proxy_0123456789ab"
PATIENCE_S = 15.0

_PEER: Final = Path(__file__).with_name("ros1_peer.py")
_MODULES: Final = ("pyroute2.netns", "proxy.endpoints.ros1.child", "tests.proxy.endpoints.ros1_modules")
_MASTER: Final = "import rosmaster.main; rosmaster.main.rosmaster_main({argv!r})"
_PREAMBLE = """
import os, rospy
def print(*words):  # whole lines, whatever the threads
    os.write(1, (" ".join(map(str, words)) + "\\n").encode())
"""

_Event = TypeVar("_Event", bound=Event)


def need_ros1() -> str:
    """Return the folder of rospy, or skip."""
    try:
        folder = rospy_folder()
    except LocalError as error:
        pytest.skip(str(error))
    if not (Path(folder) / "rosmaster").is_dir() and importlib.util.find_spec("rosmaster") is None:
        pytest.skip("there is no rosmaster here: run sudo scripts/setup_ros1.sh")
    return folder


class Peer:
    """Process of rospy code; it prints ``ready`` first, and its lines are read with a timeout."""

    def __init__(self, code: str, environment: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(_PEER), _PREAMBLE + code],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        self._text = b""

    def line(self) -> str:
        assert self.process.stdout is not None
        until_s = time.monotonic() + PATIENCE_S
        while b"\n" not in self._text:
            ready, _, _ = select.select([self.process.stdout], [], [], max(0.0, until_s - time.monotonic()))
            piece = os.read(self.process.stdout.fileno(), 65536) if ready else b""
            if not piece:
                raise AssertionError(f"the peer said no more; so far {self._text!r}, exit {self.process.poll()}")
            self._text += piece
        line, _, self._text = self._text.partition(b"\n")
        return line.decode()

    def until(self, line: str) -> None:
        while self.line() != line:
            pass

    def tell(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line.encode() + b"\n")
        self.process.stdin.flush()

    def end(self, *, kindly: bool = True) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        if not self.process.stdin.closed:
            self.process.stdin.close()
        self.process.terminate() if kindly else self.process.kill()
        try:
            self.process.wait(5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.process.stdout.close()


class Ear:
    """Endpoint and its events."""

    def __init__(self, endpoint: Ros1Endpoint) -> None:
        self.endpoint = endpoint
        self.events: list[Event] = []

    def until(self, found: Callable[[], bool], patience_s: float = PATIENCE_S) -> None:
        def poll() -> None:
            """Wait for events; a change that is counted but not reported (subscribers) wakes too."""
            select.select([self.endpoint], [], [], 0.5)
            self.events += self.endpoint.poll_events()

        until(found, lambda: f"events: {str(self.events)[-2000:]}, {self.endpoint.graph()}", patience_s, poll)

    def of(self, kind: type[_Event], handle: int | None = None) -> list[_Event]:
        return [
            event
            for event in self.events
            if isinstance(event, kind) and (handle is None or getattr(event, "handle", None) == handle)
        ]

    def wait(self, kind: type[_Event], count: int = 1, handle: int | None = None) -> list[_Event]:
        self.until(lambda: len(self.of(kind, handle)) >= count)
        return self.of(kind, handle)

    def wait_end(self, name: str, node: str | None = None, *, gone: bool = False) -> None:
        def is_there() -> bool:
            return any(end.name == name and node in (None, end.node) for end in self.endpoint.graph())

        self.until(lambda: is_there() != gone)


class Net:
    """Master and its peers."""

    def __init__(self, folder: str, logs: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.uri = f"http://127.0.0.1:{self.port}"
        self.environment = {
            **os.environ,
            "ROS_MASTER_URI": self.uri,
            "ROS_IP": "127.0.0.1",
            "ROS_LOG_DIR": str(logs),
            "PYTHONPATH": folder,
            "PYTHONUNBUFFERED": "1",
        }
        self._peers: list[Peer] = []
        self.endpoints: list[Ros1Endpoint] = []
        self._master: subprocess.Popen[bytes] | None = None

    def start_master(self) -> None:
        self._master = subprocess.Popen(
            [sys.executable, str(_PEER), _MASTER.format(argv=["rosmaster", "--core", "-p", str(self.port)])],
            env=self.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        until(self._answers, "the master is up", PATIENCE_S)

    def _answers(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def stop_master(self) -> None:
        if self._master is not None:
            self._master.kill()
            self._master.wait()
            self._master = None

    def peer(self, code: str) -> Peer:
        peer = Peer(code, self.environment)
        self._peers.append(peer)
        peer.until("ready")
        return peer

    def endpoint(self, node: str = NODE) -> Ear:
        endpoint = Ros1Endpoint(self.uri, node)
        self.endpoints.append(endpoint)
        return Ear(endpoint)

    def end_peers(self) -> None:
        """End the peers."""
        for peer in self._peers:
            peer.end(kindly=False)
        self._peers.clear()

    def leave(self) -> None:
        """End the peers and endpoints."""
        for endpoint in self.endpoints:
            endpoint.shut_down()
        self.endpoints.clear()
        self.end_peers()

    def stop(self) -> None:
        """End everything."""
        self.leave()
        self.stop_master()


@functools.cache
def _ros1_zygote() -> zygote.Zygote:
    return zygote.Zygote.start(_MODULES)


@contextmanager
def ros1_net(logs: Path) -> Iterator[Net]:
    """Running master; everything is stopped at the end."""
    net = Net(need_ros1(), logs)
    forked = None if zygote.Popen.zygote is None else _ros1_zygote()
    with mock.patch.dict(os.environ, ROS_IP="127.0.0.1"), mock.patch.object(zygote.Popen, "zygote", forked):
        try:
            net.start_master()
            yield net
        finally:
            net.stop()
