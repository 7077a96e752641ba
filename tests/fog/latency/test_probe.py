"""Latency probes by TCP connect and UDP echo."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from fog.latency.config import ProbeEndpoint
from fog.latency.probe import TRIES, probe, probe_all


@contextmanager
def echo(*, lies_first: bool = False) -> Iterator[int]:
    """Give the port of a UDP echo service, which may send something else first."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))

        def serve() -> None:
            for _ in range(TRIES):
                data, sender = server.recvfrom(64)
                if lies_first:
                    server.sendto(b"not yours", sender)
                server.sendto(data, sender)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield server.getsockname()[1]
        thread.join(10)


def closed_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


def test_a_connect_is_timed() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        found = probe(ProbeEndpoint("tcp", "127.0.0.1", server.getsockname()[1]), 10.0)
    assert found.ms is not None
    assert found.ms > 0


@pytest.mark.parametrize("lies_first", [False, True])
def test_an_echo_is_timed_and_only_our_own_datagram_counts(lies_first: bool) -> None:
    with echo(lies_first=lies_first) as port:
        found = probe(ProbeEndpoint("udp", "127.0.0.1", port), 10.0)
    assert found.ms is not None
    assert found.ms > 0


def test_an_endpoint_that_does_not_answer_is_unknown_and_says_why() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute:
        mute.bind(("127.0.0.1", 0))
        found = probe_all(
            {
                "refuses": ProbeEndpoint("tcp", "127.0.0.1", closed_port(socket.SOCK_STREAM)),
                "refuses too": ProbeEndpoint("udp", "127.0.0.1", closed_port(socket.SOCK_DGRAM)),
                "silent": ProbeEndpoint("udp", "127.0.0.1", mute.getsockname()[1]),
            },
            0.05,
        )
    assert {name: (each.ms, each.reason) for name, each in found.items()} == {
        "refuses": (None, "Connection refused"),
        "refuses too": (None, "Connection refused"),
        "silent": (None, "no answer within 0.05 s"),
    }


@pytest.mark.parametrize(
    ("text", "endpoint"),
    [
        ("127.0.0.1:80", ProbeEndpoint("tcp", "127.0.0.1", 80)),
        ("udp://[::1]:7", ProbeEndpoint("udp", "::1", 7)),
        ("tcp://a.example:443", ProbeEndpoint("tcp", "a.example", 443)),
    ],
)
def test_the_forms_of_an_endpoint_are_read(text: str, endpoint: ProbeEndpoint) -> None:
    assert ProbeEndpoint.from_text(text) == endpoint
    assert ProbeEndpoint.from_text(endpoint.to_text()) == endpoint


@pytest.mark.parametrize("text", ["", "host", "host:0", "host:65536", "icmp://host:1", "ho st:1"])
def test_what_is_no_endpoint_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected HOST:PORT"):
        ProbeEndpoint.from_text(text)
