"""A connection at the TLS port goes to the relay, or to the enrolment server, by its first bytes."""

from __future__ import annotations

import socket
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from gdp.enrolment.channel import client_context
from gdp.enrolment.server import bind_unix
from gdp.links.relay_hello import HelloWait, hand_over
from gdp.links.relay_loop import RelayLoop


class Port:
    """A loop with one accepted connection, and what was chosen for it."""

    def __init__(self, stack: ExitStack) -> None:
        self.loop = RelayLoop()
        stack.callback(self.loop.close)
        with socket.create_server(("127.0.0.1", 0)) as listening:
            self.client = socket.create_connection(listening.getsockname())
            self.accepted, _ = listening.accept()
        stack.callback(self.client.close)
        stack.callback(self.accepted.close)
        self.accepted.setblocking(False)
        self.chosen: list[bool] = []
        self.wait = HelloWait(
            loop=self.loop, accepted=self.accepted, chosen=lambda _, __, is_enrolment: self.chosen.append(is_enrolment)
        )

    def run(self, until: Callable[[], bool]) -> None:
        """Work until something holds."""
        self.loop.run(until)


@pytest.fixture
def port() -> Iterator[Port]:
    with ExitStack() as stack:
        yield Port(stack)


def hello(*, is_enrolment: bool) -> bytes:
    """Return the first bytes of a client."""
    context = client_context()
    if not is_enrolment:
        context.set_alpn_protocols(["gdp-relay/1"])
    sent = ssl.MemoryBIO()
    with pytest.raises(ssl.SSLWantReadError):
        context.wrap_bio(ssl.MemoryBIO(), sent).do_handshake()
    return sent.read()


@pytest.mark.parametrize("is_enrolment", [True, False])
def test_the_protocol_of_the_hello_chooses_and_no_byte_is_taken(port: Port, is_enrolment: bool) -> None:
    first = hello(is_enrolment=is_enrolment)
    port.client.send(first)
    port.run(lambda: bool(port.chosen))
    assert port.chosen == [is_enrolment]
    assert port.accepted.recv(1 << 14) == first


def test_a_hello_in_pieces_is_waited_for_without_work(port: Port) -> None:
    first = hello(is_enrolment=True)
    port.client.send(first[:9])
    port.loop.step()
    begun_s = time.monotonic()
    for _ in range(2):  # a step that nothing wakes lasts until the next second of the loop
        port.loop.step()
    assert time.monotonic() - begun_s > 0.5, "the loop is woken by bytes that it has seen"
    assert not port.chosen
    port.client.send(first[9:])
    port.run(lambda: bool(port.chosen))
    assert port.chosen == [True]


def test_what_is_no_hello_is_the_relays(port: Port) -> None:
    port.client.send(b"GET / HTTP/1.1\r\n")
    port.run(lambda: bool(port.chosen))
    assert port.chosen == [False]


def test_a_peer_that_leaves_early_is_noticed(port: Port) -> None:
    port.client.send(hello(is_enrolment=True)[:9])
    port.client.close()
    port.run(lambda: bool(port.chosen))
    assert port.chosen == [False]


def test_a_connection_is_handed_over_with_its_bytes(tmp_path: Path) -> None:
    with closing(bind_unix(tmp_path / "handover.sock", socket.SOCK_DGRAM)) as receiver:
        client, accepted = socket.socketpair()
        with client:
            client.send(b"hello")
            hand_over(accepted, tmp_path / "handover.sock")
            assert accepted.fileno() == -1
            _, descriptors, _, _ = socket.recv_fds(receiver, 1, 1)
            with socket.socket(fileno=descriptors[0]) as handed:
                assert handed.recv(16) == b"hello"


def test_without_an_enrolment_server_the_connection_is_closed(tmp_path: Path) -> None:
    client, accepted = socket.socketpair()
    with client, pytest.raises(FileNotFoundError):
        hand_over(accepted, tmp_path / "handover.sock")
    assert accepted.fileno() == -1
