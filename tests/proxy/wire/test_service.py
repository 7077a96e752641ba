"""Service protocol between proxies: round trips and refusals."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import RemoteError
from gdp.limits import MESSAGE_MAX_BYTES
from gdp.service.dispatch import STOP_MAX
from gdp.service.frames import PATIENCE_MAX_MS, Answer, Outcome, Request, Stop
from proxy.wire.service import Exchange, News, too_large
from tests.proxy.bridge import known

SWITCH = known.services()[known.SET_BOOL]
TEXT = known.channel(known.STRING)

parts = st.integers(0, 255)
calls = st.integers(0, (1 << 64) - 1)


@given(parts, calls, st.integers(0, PATIENCE_MAX_MS), st.binary())
def test_a_request_there_and_back_is_the_same(part: int, call: int, patience_ms: int, body: bytes) -> None:
    request = Request(part, call, patience_ms, body)
    assert Request.from_wire(request.to_wire()) == request


@given(parts, calls, st.sampled_from(Outcome), st.binary())
def test_an_answer_there_and_back_is_the_same(part: int, call: int, outcome: Outcome, body: bytes) -> None:
    answer = Answer(part, call, outcome, body)
    assert Answer.from_wire(answer.to_wire()) == answer


@given(parts, calls, st.binary())
def test_news_there_and_back_are_the_same(part: int, stamp_ns: int, body: bytes) -> None:
    news = News(part, stamp_ns, body)
    assert News.from_wire(news.to_wire()) == news


@given(st.integers(0, 127), st.lists(calls, min_size=1))
def test_a_word_to_stop_there_and_back_is_the_same_and_is_no_request(part: int, ended: list[int]) -> None:
    stop = Stop(part, tuple(ended))
    assert Stop.from_wire(stop.to_wire()) == stop
    assert Stop.is_in(stop.to_wire())
    assert not Stop.is_in(Request(part, ended[0], 0, b"").to_wire())


@pytest.mark.parametrize("wire", [b"\1\x80", b"\1\x80" + bytes(9), b"\1\0" + bytes(8), b"\2\x80" + bytes(8), b""])
def test_a_word_to_stop_that_names_no_calls_is_refused(wire: bytes) -> None:
    with pytest.raises(RemoteError):
        Stop.from_wire(wire)


def test_a_word_to_stop_names_at_most_so_many_as_our_side_ever_sends() -> None:
    longest = Stop(0, tuple(range(STOP_MAX)))
    assert Stop.from_wire(longest.to_wire()) == longest
    with pytest.raises(RemoteError, match="more than 1024 ended calls"):
        Stop.from_wire(Stop(0, tuple(range(STOP_MAX + 1))).to_wire())


@pytest.mark.parametrize(
    "read", [Request.from_wire, Answer.from_wire, News.from_wire, Stop.from_wire, Exchange.from_cbor]
)
@given(wire=st.binary(max_size=64))
def test_any_bytes_are_read_or_refused(read: Callable[[bytes], object], wire: bytes) -> None:
    with contextlib.suppress(RemoteError):
        assert read(wire) is not None


def test_an_answer_that_says_neither_yes_nor_no_is_refused() -> None:
    wire = bytearray(Answer(0, 1, Outcome.ANSWERED, b"body").to_wire())
    wire[10] = 2
    with pytest.raises(RemoteError, match="neither yes nor no"):
        Answer.from_wire(bytes(wire))


def test_a_reason_is_bounded_and_always_readable() -> None:
    answer = Answer.failed(0, 1, "ü" * 2_000)
    assert len(answer.body) == 1_024
    assert answer.reason == "ü" * 512
    assert Answer(0, 1, Outcome.FAILED, b"\xff" * 2_000).reason == "\ufffd" * 1_024


def test_a_description_there_and_back_is_the_same() -> None:
    for is_leaving in (False, True):
        exchange = Exchange("cbor", (SWITCH, SWITCH, SWITCH), (TEXT, TEXT), is_leaving)
        assert Exchange.from_cbor(exchange.to_cbor()) == exchange


@pytest.mark.parametrize(
    "exchange",
    [Exchange("json", ()), Exchange("json", (SWITCH,) * 6, (TEXT,) * 3)],
    ids=["no services", "too many parts"],
)
def test_a_description_of_too_little_or_too_much_is_refused(exchange: Exchange) -> None:
    with pytest.raises(RemoteError, match="a description of a service"):
        Exchange.from_cbor(exchange.to_cbor())


def test_what_cannot_travel_has_a_reason() -> None:
    assert too_large("a request", 100, 100, 200) == ""
    assert too_large("a request", 101, 100, 200) == "a request of 101 bytes; the rule's max_bytes is 100"
    assert "as it travels" in too_large("a request", 100, 100, MESSAGE_MAX_BYTES)
    largest = Request(0, 0, 0, bytes(MESSAGE_MAX_BYTES - 14)).to_wire()
    assert len(largest) == MESSAGE_MAX_BYTES
    assert too_large("a request", 1, 1, MESSAGE_MAX_BYTES - 14) == ""
