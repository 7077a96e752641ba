"""One bounded HTTP server: what every use of it may rely on."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from http.client import HTTPConnection
from pathlib import Path

import pytest

from gdp.http_server import Answer, HttpServer

Serve = Callable[[Callable[[str], Answer]], HTTPConnection]


@pytest.fixture
def serve() -> Iterator[Serve]:
    with ExitStack() as stack:

        def start(answer: Callable[[str], Answer]) -> HTTPConnection:
            listener = socket.create_server(("127.0.0.1", 0))
            server = HttpServer(listener, answer, name="test", connections=2, timeout_s=10.0, is_for_downloads=True)
            stack.callback(server.close)
            return stack.enter_context(closing(HTTPConnection("127.0.0.1", server.port, timeout=10.0)))

        yield start


def test_a_file_of_several_pieces_arrives_whole(serve: Serve, tmp_path: Path) -> None:
    content = bytes(range(256)) * 4_000
    (tmp_path / "file").write_bytes(content)
    client = serve(lambda _: Answer("200 OK", tmp_path / "file"))
    client.request("GET", "/")
    assert client.getresponse().read() == content


def test_an_answer_that_fails_is_an_error_of_the_server(serve: Serve) -> None:
    def fails(path: str) -> Answer:
        raise ValueError(path)

    client = serve(fails)
    client.request("GET", "/")
    assert client.getresponse().status == 500


def test_only_the_head_is_sent_if_only_that_was_requested(serve: Serve) -> None:
    client = serve(lambda path: Answer("200 OK", path.encode()))
    client.request("HEAD", "/abc?more")
    response = client.getresponse()
    assert (response.headers["Content-Length"], response.read()) == ("4", b"")
