"""Control protocol: requests and responses as lines."""

from __future__ import annotations

import contextlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import LocalError
from gdp.names import Name
from gdp.state.control_protocol import (
    LINE_MAX_BYTES,
    RESPONSE_MAX_BYTES,
    Command,
    ControlRequestError,
    LineBuffer,
    Request,
    Response,
    decode_request,
    decode_response,
    encode_request,
    encode_response,
)

NAMED = {"name": Name(bytes(range(32))).to_text()}
REQUESTS = [Request(each, NAMED if each is Command.LOOKUP else {}) for each in Command]


@pytest.mark.parametrize("request_", REQUESTS)
def test_a_request_survives_encoding(request_: Request) -> None:
    assert decode_request(encode_request(request_).rstrip(b"\n")) == request_


@pytest.mark.parametrize("name", [None, 1, "", "75e", "g" * 64])
def test_a_lookup_without_a_name_is_refused(name: object) -> None:
    with pytest.raises(ControlRequestError, match="name"):
        decode_request(json.dumps({"command": "lookup", "name": name}).encode())


def test_the_arguments_of_a_request_survive_encoding() -> None:
    request = Request(Command.ASK, {"id": 7, "ask": "ping", "target": None})
    assert decode_request(encode_request(request).rstrip(b"\n")) == request


def test_a_request_above_the_limit_is_not_sent() -> None:
    with pytest.raises(LocalError, match="at most 4096"):
        encode_request(Request(Command.ASK, {"body": "x" * LINE_MAX_BYTES}))


@pytest.mark.parametrize("response", [Response({"state": "running", "pid": 7}), Response(error="no")])
def test_a_response_survives_encoding(response: Response) -> None:
    assert decode_response(encode_response(response).rstrip(b"\n")) == response


@pytest.mark.parametrize(
    "line",
    [b"", b"reload", b"[]", b"{}", b'{"command": 1}', b'{"command": "status", "more": 1}', b"\xff", b"[" * 4_000],
)
def test_a_line_that_is_no_request_is_refused(line: bytes) -> None:
    with pytest.raises(ControlRequestError, match="expected"):
        decode_request(line)


def test_an_unknown_command_is_answered_with_the_known_ones() -> None:
    known = "ask, drain, incident, lookup, reload, show, snapshot, status, topics, topology"
    with pytest.raises(ControlRequestError, match=f"unknown command 'dance'; expected {known}"):
        decode_request(json.dumps({"command": "dance"}).encode())


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_a_request_or_refused(line: bytes) -> None:
    with contextlib.suppress(ControlRequestError):
        decode_request(line)


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_a_response_or_refused(line: bytes) -> None:
    with contextlib.suppress(ControlRequestError):
        decode_response(line)


def test_lines_are_put_together_from_pieces() -> None:
    lines = LineBuffer(100)
    assert lines.receive_bytes(b"a") == []
    assert lines.receive_bytes(b"b\nc\nd") == [b"ab", b"c"]
    assert lines.receive_bytes(b"\n") == [b"d"]


def test_a_line_of_the_largest_size_is_taken() -> None:
    assert LineBuffer(LINE_MAX_BYTES).receive_bytes(b"x" * (LINE_MAX_BYTES - 1) + b"\n") == [
        b"x" * (LINE_MAX_BYTES - 1)
    ]


def test_a_line_that_never_ends_is_refused() -> None:
    lines = LineBuffer(10)
    lines.receive_bytes(b"123456789")
    with pytest.raises(ControlRequestError, match="at most 10 bytes"):
        lines.receive_bytes(b"0")


def test_a_response_that_no_client_accepts_is_not_sent() -> None:
    with pytest.raises(LocalError, match="at most"):
        encode_response(Response({"text": "x" * RESPONSE_MAX_BYTES}))
