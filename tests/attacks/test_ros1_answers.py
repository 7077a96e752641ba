"""Attacks with the messages of a ROS 1 server and the responses of a ROS 1 master."""

from __future__ import annotations

import ast
import random
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from proxy.endpoints.ros1.master import Master, MasterError, MasterWatch

SERVICES = Path(__file__).parents[2] / "proxy/endpoints/ros1/services.py"
XML = "<?xml version='1.0'?><methodResponse><params><param><value>{}</value></param></params></methodResponse>"
STATE = "<array><data><value><int>1</int></value><value></value><value>{}</value></data></array>"
ANSWERS = [
    "",
    "<",
    "<a><b></a>",
    "no XML",
    "<methodResponse/>",
    XML.format("<int>x</int>"),
    XML.format("<int>" + "9" * 5_000 + "</int>"),
    XML.format("<double>x</double>"),
    XML.format("<boolean>7</boolean>"),
    XML.format("<base64>%%%</base64>"),
    XML.format("<dateTime.iso8601>x</dateTime.iso8601>"),
    XML.format("<struct><member><value>1</value></member></struct>"),
    XML.format("<struct><member><name>faultCode</name></member></struct>"),
    XML.format("<array></array>"),
    XML.format("<array><data>" + "<value><array><data>" * 2_000),
    XML.format("<array><data><value>" + STATE.format("<int>1</int>") + "</value></data></array>"),
    XML.format(
        f"<array><data><value><array><data><value>{STATE.format('')}</value></data></array></value></data></array>"
    ),
    "<!DOCTYPE a [<!ENTITY b 'bbbbbbbb'><!ENTITY c '&b;&b;&b;&b;'>]>" + XML.format("&c;"),
]


def _read_request(peer: socket.socket) -> None:
    """Read a whole HTTP request: closing a socket with unread bytes would reset the connection under the response."""
    with peer.makefile("rb") as request:
        length = 0
        while (line := request.readline()).strip():
            key, _, value = line.partition(b":")
            if key.lower() == b"content-length":
                length = int(value)
        request.read(length)


@contextmanager
def master(answer: bytes, head: bytes = b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\n") -> Iterator[str]:
    """Serve one response to every request."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            while True:
                try:
                    peer, _ = server.accept()
                except OSError:
                    return
                with peer:
                    _read_request(peer)
                    peer.sendall(head + f"Content-Length: {len(answer)}\r\n\r\n".encode() + answer)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.getsockname()[1]}/"
        finally:
            server.shutdown(socket.SHUT_RDWR)
            thread.join()


@pytest.mark.parametrize("answer", ANSWERS)
def test_a66_an_answer_of_a_master_that_is_none_is_an_error_of_the_master(answer: str) -> None:
    with master(answer.encode()) as uri, pytest.raises(MasterError):
        MasterWatch(uri, "/me").poll()


def test_a66_what_a_broken_answer_leaves_is_an_error_of_the_master() -> None:
    good = XML.format(f"<array><data><value>{STATE.format('<string>x</string>')}</value></data></array>").encode()
    rng = random.Random(66)
    for _ in range(150):
        broken = bytearray(good)
        for _ in range(rng.randint(1, 6)):
            at = rng.randrange(len(broken))
            broken[at : at + rng.randint(0, 9)] = bytes(rng.choices(b"<>/&;x0\xff\0value", k=rng.randint(0, 6)))
        with master(bytes(broken)) as uri:
            try:
                Master(uri, "/me").call_batch(("getSystemState",))
            except MasterError:
                continue


def test_a66_an_endless_answer_of_a_master_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("proxy.endpoints.ros1.master._ANSWER_MAX_BYTES", 100_000)
    with master(XML.format("x" * 200_000).encode()) as uri, pytest.raises(MasterError, match="more than"):
        Master(uri, "/me").call_batch(("getSystemState",))


def test_a66_a_packed_answer_of_a_master_is_refused() -> None:
    head = b"HTTP/1.1 200 OK\r\nContent-Encoding: gzip\r\n"
    with master(b"\x1f\x8b", head) as uri, pytest.raises(MasterError, match="encoding"):
        Master(uri, "/me").call_batch(("getSystemState",))


def reason() -> object:
    """Return the function that reads a server's messages; its module needs rospy, which few machines have."""
    tree = ast.parse(SERVICES.read_text())
    wanted = [
        node
        for node in tree.body
        if (isinstance(node, ast.FunctionDef) and node.name == "_reason")
        or (isinstance(node, ast.AnnAssign) and ast.unparse(node.target) in ("_SAID_MAX", "_RESPONDED", "_CANNOT"))
    ]
    names: dict[str, object] = {"ast": ast, "Final": object}
    module = ast.Module([*ast.parse("from __future__ import annotations").body, *wanted], [])
    exec(compile(module, str(SERVICES), "exec"), names)
    return names["_reason"]


@pytest.mark.parametrize(
    "said", ["-" * 100_000, "not " * 100_000, "[" * 100_000, "(" * 90 + "1", "{[]: 1}", "{{}}", "b'"]
)
def test_a66_words_of_a_server_are_taken_as_they_are_where_they_are_no_literal(said: str) -> None:
    read = reason()
    assert callable(read)
    assert read(Exception(f"service [/s] responded with an error: {said}")) == said[:4_096]


def test_a66_words_of_a_server_are_unwrapped() -> None:
    read = reason()
    assert callable(read)
    assert read(Exception("service [/s] responded with an error: b'service cannot process request: no'")) == "no"
