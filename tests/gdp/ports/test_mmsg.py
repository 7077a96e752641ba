"""Both kinds of batch over a pair of local datagram sockets: the same calls as on a packet socket, unprivileged."""

from __future__ import annotations

import errno
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp import burst
from gdp.errors import DROP_COUNTERS, DropReason
from gdp.frame.codec import HOPS_AT, Header, encode
from gdp.ports.mmsg import SLOTS, Batch, CompiledBatch, MmsgBatch, make_batch, send_failure
from gdp.sansio import ReceivedFrame

_BUILT = pytest.mark.skipif(burst.SYSTEM_CALLS is None, reason="the burst core in use has no compiled system calls")
KINDS = pytest.mark.parametrize("kind", [MmsgBatch, pytest.param(CompiledBatch, marks=_BUILT)])
MACS = bytes(range(12))
ETHER = MACS + b"\x88\xb5"

Pair = tuple[socket.socket, socket.socket]
Make = Callable[[int], Batch]


@pytest.fixture
def pair() -> Iterator[Pair]:
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    for end in (one, other):
        end.setblocking(False)
    yield one, other
    one.close()
    other.close()


def received(end: socket.socket) -> list[bytes]:
    frames = []
    while True:
        try:
            frames.append(end.recv(1 << 16))
        except BlockingIOError:
            return frames


def data(destination: bytes = b"d", payload: bytes = b"payload", hops_left: int = 16) -> bytes:
    """Return a data frame with its Ethernet header."""
    return ETHER + encode(Header(1, 0, hops_left, 1, len(payload), 7, 0, 1, 9, destination * 32, b"s" * 32)) + payload


def key_of(destination: bytes) -> bytes:
    """Return the key of such a frame."""
    return destination * 32 + b"s" * 32


def one_less(frame: bytes) -> bytes:
    """Return a frame as it is forwarded."""
    at = len(ETHER) + HOPS_AT
    return frame[:at] + bytes([frame[at] - 1]) + frame[at + 1 :]


def forwarded(batch: Batch, frames: Sequence[bytes], pair: Pair, drops: list[int]) -> tuple[int, int]:
    """Let frames be received and forwarded to one sink; return how many came, and how many left."""
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with one, other:
        for frame in frames:
            one.send(frame)
        return batch.forward(other, lambda _key, _largest: [(pair[0].fileno(), MACS)], refuse, drops)


def refuse(*values: object) -> Any:
    raise AssertionError(values)


def no_drops() -> list[int]:
    return [0] * DROP_COUNTERS


@KINDS
def test_frames_are_forwarded_in_order_under_a_new_ethernet_header_with_one_hop_less(kind: Make, pair: Pair) -> None:
    frames, drops = [data(payload=b"%d" % each * each) for each in range(9)], no_drops()
    old = [bytes(12) + frame[12:] for frame in frames]
    assert forwarded(kind(300), old, pair, drops) == (9, 9)
    assert received(pair[1]) == [one_less(frame) for frame in frames]
    assert drops == no_drops()


@KINDS
@given(
    st.lists(
        st.tuples(
            st.sampled_from([b"a", b"b", b"c"]), st.binary(max_size=60), st.sampled_from([16, 16, 144, 1, 129]),
            st.sampled_from([0, 0, 0, 5]),
        ),
        max_size=SLOTS,
    ),
    st.lists(st.integers(0, SLOTS - 1), max_size=2),
)  # fmt: skip
def test_each_frame_goes_once_to_each_hop_or_to_the_node_in_order(
    kind: Make, drawn: list[tuple[bytes, bytes, int, int]], cut: list[int]
) -> None:
    frames = [data(*each[:3])[: -each[3] or None] for each in drawn]
    frames = [frame[:50] if at in cut else frame for at, frame in enumerate(frames)]
    hops = {key_of(b"a"): 1, key_of(b"b"): 2}  # of the others none is known
    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(3)]
    others, largest, drops = list[bytes](), list[tuple[bytes, int]](), no_drops()
    (one, source), *sinks = pairs

    def route(key: bytes, size: int) -> list[tuple[int, bytes]]:
        largest.append((key, size))
        return [(sink.fileno(), MACS) for sink, _ in sinks[: hops.get(key, 0)]]

    with ExitStack() as stack:
        for end in (each for pair in pairs for each in pair):
            end.setblocking(False)
            stack.enter_context(end)
        for frame in frames:
            one.send(frame)
        came, left = kind(300).forward(source, route, others.append, drops)
        got = [received(sink) for _, sink in sinks]
    taken = [
        each[0] if at not in cut and frame == data(*each[:3]) and each[2] == 16 else b"c"
        for at, (frame, each) in enumerate(zip(frames, drawn, strict=True))
    ]
    for sink, to in ((0, b"ab"), (1, b"b")):
        assert got[sink] == [one_less(frame) for frame, each in zip(frames, taken, strict=True) if each in to]
    assert others == [frame for frame, each in zip(frames, taken, strict=True) if each == b"c"]
    assert (came, left) == (len(frames), sum(map(len, got)))
    assert all(size >= 96 for _, size in largest)
    assert drops == no_drops()


@KINDS
def test_a_failing_route_or_node_is_heard(kind: Make, pair: Pair) -> None:
    batch = kind(300)
    for route in (refuse, lambda *_: ()):
        pair[1].send(data())
        with pytest.raises(AssertionError):
            batch.forward(pair[0], route, refuse, no_drops())
    pair[1].send(data())
    assert batch.forward(pair[0], lambda *_: (), lambda _: None, no_drops()) == (1, 0)


@KINDS
def test_what_is_received_are_frames_of_a_port_with_their_senders(kind: Make, pair: Pair) -> None:
    batch = kind(200)
    assert not batch.receive_frames(pair[0], 3)
    for frame in (b"one", b"two"):
        pair[1].send(ETHER + frame)
    assert [*batch.receive_frames(pair[0], 3)] == [ReceivedFrame(3, MACS[6:], frame) for frame in (b"one", b"two")]


@KINDS
def test_frames_of_the_caller_leave_in_order_however_many(kind: Make) -> None:
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with one, other:
        frames, drops = [b"%d" % each for each in range(2 * SLOTS + 5)], no_drops()
        other.setblocking(False)
        assert kind(200).send(one, frames, MACS, drops) == len(frames)
        assert received(other) == [ETHER + frame for frame in frames]


@KINDS
def test_frames_of_the_caller_that_cannot_leave_are_counted(kind: Make, pair: Pair) -> None:
    pair[0].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8_192)
    batch, drops = kind(200), no_drops()
    assert batch.send(pair[0], [b"a", bytes(60_000), b"b"], MACS, drops) == 2
    assert received(pair[1]) == [ETHER + b"a", ETHER + b"b"]
    left = batch.send(pair[0], [b"x"] * 1_000, MACS, drops)
    assert left == len(received(pair[1]))
    pair[1].close()
    assert batch.send(pair[0], [b"x", b"y"], MACS, drops) == 0
    counts = drops[DropReason.TOO_BIG], drops[DropReason.PORT_FULL], drops[DropReason.PORT_DOWN]
    assert counts == (1, 1_000 - left, 2)


@KINDS
def test_taking_from_an_empty_socket_gives_nothing(kind: Make, pair: Pair) -> None:
    assert [*kind(200).receive_frames(pair[0], 0)] == []


@KINDS
def test_at_most_a_batch_is_taken_at_once(kind: Make) -> None:
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with one, other:
        one.setblocking(False)
        batch, sizes = kind(200), []
        for _ in range(3):
            for _ in range(SLOTS // 2):
                other.send(bytes(20))
        while got := batch.receive_frames(one, 0):
            sizes.append(len(got))
    assert sizes == [SLOTS, SLOTS // 2]


@KINDS
def test_a_frame_longer_than_a_slot_arrives_cut_and_spoils_no_other(kind: Make, pair: Pair) -> None:
    batch = kind(64)
    pair[1].send(b"a" * 100)
    pair[1].send(b"b" * 20)
    got = [*batch.receive_frames(pair[0], 0)]
    assert [each.frame for each in got] == [b"a" * 50, b"b" * 6]
    assert got[1].mac == b"b" * 6


@KINDS
def test_a_full_queue_costs_the_frames_and_counts_them(kind: Make, pair: Pair) -> None:
    batch, drops, left = kind(300), no_drops(), 0
    for _ in range(100):
        left += forwarded(batch, [data()] * SLOTS, pair, drops)[1]
    assert left == len(received(pair[1]))
    assert drops[DropReason.PORT_FULL] == 100 * SLOTS - left > 0
    assert sum(drops) == drops[DropReason.PORT_FULL]


@KINDS
def test_a_sink_that_is_gone_counts_as_down(kind: Make, pair: Pair) -> None:
    drops = no_drops()
    pair[1].close()
    assert forwarded(kind(300), [data()] * 2, pair, drops) == (2, 0)
    assert drops[DropReason.PORT_DOWN] == 2


@KINDS
def test_one_frame_that_is_too_long_does_not_stop_the_others(kind: Make, pair: Pair) -> None:
    pair[0].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8_192)
    drops, frames = no_drops(), [data(payload=b"a"), data(payload=bytes(60_000)), data(payload=b"b")]
    assert forwarded(kind(65_000), frames, pair, drops) == (3, 2)
    assert received(pair[1]) == [one_less(frames[0]), one_less(frames[2])]
    assert drops[DropReason.TOO_BIG] == 1


@pytest.mark.parametrize(
    ("number", "reason", "goes_on"),
    [
        (errno.ENOBUFS, DropReason.PORT_FULL, True),
        (errno.EAGAIN, DropReason.PORT_FULL, False),
        (errno.EMSGSIZE, DropReason.TOO_BIG, True),
        (errno.ENETDOWN, DropReason.PORT_DOWN, False),
        (errno.ENXIO, DropReason.PORT_DOWN, False),
    ],
)
def test_an_errno_says_why_a_frame_was_lost(number: int, reason: DropReason, *, goes_on: bool) -> None:
    assert send_failure(number) == (reason, goes_on)


def test_the_burst_core_in_use_makes_the_system_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    assert isinstance(make_batch(200), MmsgBatch if burst.SYSTEM_CALLS is None else CompiledBatch)
    monkeypatch.setattr(burst, "SYSTEM_CALLS", None)
    assert type(make_batch(200)) is MmsgBatch
