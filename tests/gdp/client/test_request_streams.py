"""Requests of a client to servers: what has not left when its call ends never leaves."""

from __future__ import annotations

from gdp.client.reader_path import ReaderPaths
from gdp.client.request_streams import RequestStreams
from gdp.client.writer_proxy import WriterProxyState
from gdp.frame.codec import Kind, decode
from gdp.names import Name
from tests.gdp.client.pipe import End, Pipe, publisher_of

SERVER = Name(b"s" * 32)
LARGE = bytes(300_000)


def joined() -> tuple[RequestStreams, Pipe, End]:
    """Return requests whose one server is at the end of a pipe, in which a few frames leave at a time."""
    pipe = Pipe(publisher_of())
    end = pipe.join(SERVER)
    assert pipe.run(2.0, lambda: end.writer_proxy.state is WriterProxyState.LIVE)
    pipe.batch_bytes, pipe.pause_s = 20_000, 0.05
    return RequestStreams(publisher_of(), lambda _server, _now_s: pipe.publisher, ReaderPaths(), {}), pipe, end


def data(pipe: Pipe) -> int:
    return sum(len(frame) for frame in pipe.seen if decode(frame).kind == Kind.DATA)


def test_a_request_whose_call_goes_on_leaves_whole() -> None:
    streams, pipe, end = joined()
    streams.send_to("call", SERVER, LARGE, pipe.now_s)
    streams.cancel("another call")
    pipe.run(3.0)
    assert end.messages == [LARGE]


def test_what_has_not_left_when_a_call_ends_never_leaves_and_later_requests_do() -> None:
    streams, pipe, end = joined()
    streams.send_to("call", SERVER, LARGE, pipe.now_s)
    pipe.run(0.1)
    streams.cancel("call")
    streams.send_to("next call", SERVER, b"second", pipe.now_s)
    pipe.run(3.0)
    assert end.messages == [b"second"]
    assert 0 < data(pipe) < len(LARGE) / 2
