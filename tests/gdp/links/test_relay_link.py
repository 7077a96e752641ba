"""Relay connections on real sockets with one loop, where one end does not read."""

from __future__ import annotations

import contextlib
import ctypes
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest

from gdp.frame.codec import Flag
from gdp.links.relay_link import RelayLink, RelayPort, prepare_socket
from gdp.links.relay_loop import RelayLoop
from gdp.ports.tap import TapDevice
from gdp.relay.connection import ConnectionState, RelayConnection
from gdp.runtime.runtime import now
from tests.gdp.relay.ends import SETTINGS, Ends, ends_now
from tests.gdp.relay.test_frame_queue import frame, numbers

FRAMES = 400
PATIENCE_S = 30.0
PATIENT = replace(SETTINGS, dead_s=PATIENCE_S)  # a busy machine is no dead path


class Device:
    """Device whose other end is in the hands of the test."""

    ifname = "test"

    def __init__(self) -> None:
        self.host, self._relay = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.carrier = False
        for each in (self.host, self._relay):
            each.setblocking(False)

    def fileno(self) -> int:
        return self._relay.fileno()

    def close(self) -> None:
        self.host.close()
        self._relay.close()

    def read(self) -> bytes:
        return self._relay.recv(10_000)

    def write(self, data: bytes | memoryview) -> bool:
        try:
            return self._relay.send(data) > 0
        except BlockingIOError:
            return False

    def set_mtu(self, mtu: int) -> None:
        del mtu

    def set_carrier(self, *, on: bool) -> None:
        self.carrier = on


class Side:
    """One end: a connection on a socket, and its device."""

    def __init__(self, loop: RelayLoop, connected: socket.socket, connection: RelayConnection) -> None:
        self.device = Device()
        self.port = RelayPort(loop, cast(TapDevice, self.device))
        prepare_socket(connected, 60_000)
        self.link = RelayLink(
            loop=loop, connected=connected, connection=connection, opened=self._opened, closed=lambda _: None
        )

    def _opened(self, link: RelayLink) -> RelayPort:
        self.port.attach(link)
        return self.port

    def close(self) -> None:
        if not self.link.is_ended:
            self.link.end("the test ends")
        self.port.close()


def joined() -> tuple[socket.socket, socket.socket]:
    """Return the two ends of a TCP connection on this host."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        one = socket.create_connection(listener.getsockname())
        other, _ = listener.accept()
    return one, other


def run(loop: RelayLoop, until: Callable[[], bool]) -> None:
    """Run the loop until something is true.

    Raises:
        TimeoutError: it takes too long.
    """
    end_s = time.monotonic() + PATIENCE_S
    while not until():
        if time.monotonic() > end_s:
            raise TimeoutError("the relay does not get there")
        loop.wake_at(end_s)
        loop.step()


@pytest.fixture
def loop() -> Iterator[RelayLoop]:
    made = RelayLoop()
    yield made
    made.close()


@pytest.fixture
def both() -> Ends:
    return ends_now()


def pair(loop: RelayLoop, both: Ends) -> tuple[Side, Side]:
    """Return client and server in one loop, open."""
    one, other = joined()
    client, server = Side(loop, one, both.client(PATIENT)), Side(loop, other, both.server(PATIENT))
    run(loop, lambda: client.device.carrier and server.device.carrier)
    return client, server


def test_an_error_that_another_user_of_openssl_left_does_no_harm(loop: RelayLoop, both: Ends) -> None:
    (path,) = {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if "/libcrypto.so" in line}
    ctypes.CDLL(path).ENGINE_by_id(b"none")  # as a library of tokens does
    reader, served = pair(loop, both)
    assert reader.device.carrier
    assert served.device.carrier
    reader.close()
    served.close()


def test_a_client_that_does_not_read_does_not_delay_another(loop: RelayLoop, both: Ends) -> None:
    reader, served = pair(loop, both)
    near, far = joined()
    silent, blocked = both.client(PATIENT), Side(loop, far, both.server(PATIENT))
    near.setblocking(False)

    def shake_hands() -> bool:
        if data := silent.data_to_send(now().mono_s):
            near.sendall(data)
        with contextlib.suppress(BlockingIOError):
            silent.receive_bytes(near.recv(1 << 16), now())
        loop.wake_at(0.0)
        return blocked.device.carrier

    run(loop, shake_hands)
    got: list[bytes] = []
    sent = 0

    def feed_both() -> bool:
        nonlocal sent
        for _ in range(20):
            blocked.link.connection.queue_frame(frame(0, size=1_364))
        blocked.link.flush()
        if sent < FRAMES:
            served.device.host.send(frame(sent, Flag.RELIABLE))
            sent += 1
        with contextlib.suppress(BlockingIOError):
            got.append(reader.device.host.recv(10_000))
        loop.wake_at(0.0)
        return len(got) == FRAMES

    run(loop, feed_both)
    assert numbers(got) == list(range(FRAMES))
    assert blocked.link.connection.state is ConnectionState.OPEN
    assert blocked.link.connection.queued_bytes <= SETTINGS.queue_bytes
    near.close()
    for each in (reader, served, blocked):
        each.close()


def test_the_carrier_follows_the_connection(loop: RelayLoop, both: Ends) -> None:
    client, server = pair(loop, both)
    client.link.end("gone")
    run(loop, lambda: server.link.is_ended)
    assert (client.device.carrier, server.device.carrier) == (False, False)
    assert server.link.connection.reason == "the other end closed the connection"
    for each in (client, server):
        each.close()


def test_a_refused_client_reads_why_although_it_has_sent_more(loop: RelayLoop, both: Ends) -> None:
    one, other = joined()
    client, server = (
        Side(loop, one, both.client(PATIENT)),
        Side(loop, other, replace(both, allow=frozenset({"another"})).server()),
    )
    run(loop, lambda: client.link.is_ended and server.link.is_ended)
    assert client.link.connection.reason == "the border does not relay for member (relay allow)"
    assert not client.device.carrier
    for each in (client, server):
        each.close()
    loop.step()
