"""Metrics port, to which every user of the host may connect."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.request import urlopen

import pytest

from gdp.telemetry import metrics as metrics_module
from gdp.telemetry.metrics import Metrics
from gdp.telemetry.sources import Sources

MANY = 300


@pytest.fixture
def port() -> Iterator[int]:
    metrics = Metrics(Sources(frames=lambda: {"in": 3}))
    yield metrics.serve(0)
    metrics.close()


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def is_closed(peer: socket.socket, within_s: float) -> bool:
    peer.settimeout(within_s)
    try:
        return peer.recv(1) == b""
    except ConnectionResetError:
        return True
    except TimeoutError:
        return False


def scraped(port: int) -> bytes:
    with urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
        return bytes(answer.read())


def test_a50_silent_connections_take_neither_threads_nor_descriptors(port: int) -> None:
    threads, before = threading.active_count(), descriptors()
    with contextlib.ExitStack() as stack:
        peers = [stack.enter_context(socket.create_connection(("127.0.0.1", port), 10)) for _ in range(MANY)]
        assert all(is_closed(peer, 10.0) for peer in peers[4:])
        assert threading.active_count() == threads
        assert descriptors() - before <= MANY + 4


def test_a50_a_silent_connection_ends_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_module, "CONNECT_S", 0.5)
    metrics = Metrics(Sources(frames=lambda: {"in": 3}))
    port = metrics.serve(0)
    with socket.create_connection(("127.0.0.1", port), 10) as peer:
        peer.sendall(b"GET /met")
        assert not is_closed(peer, 0.2)
        assert is_closed(peer, 10.0)
    assert b"gdp_frames_total" in scraped(port)
    metrics.close()


def test_a50_an_endless_request_is_cut_off(port: int) -> None:
    with socket.create_connection(("127.0.0.1", port), 10) as peer:
        with contextlib.suppress(ConnectionError):
            for _ in range(64):
                peer.sendall(b"x" * 1_024)
        assert is_closed(peer, 2.0)


def test_a50_a_flood_of_connections_leaves_the_node_its_processor_time(port: int) -> None:
    child = os.fork()
    if not child:
        end_s = time.monotonic() + 1.0
        while time.monotonic() < end_s:
            with contextlib.suppress(OSError):
                socket.create_connection(("127.0.0.1", port), 1).close()
        os._exit(0)
    begun_s = time.process_time()
    os.waitpid(child, 0)
    assert time.process_time() - begun_s < 0.5  # of 1 s: half a core would be the server's


def test_a50_what_is_no_scrape_is_answered_and_closed(port: int) -> None:
    with socket.create_connection(("127.0.0.1", port), 10) as peer:
        peer.sendall(b"POST / HTTP/1.1\r\n\r\n")
        assert peer.recv(100).startswith(b"HTTP/1.1 405")
