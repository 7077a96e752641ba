"""Both kinds of batch over a pair of local datagram sockets: the same calls as on a packet socket, unprivileged."""

from __future__ import annotations

import errno
import socket
from collections.abc import Callable, Iterator

import pytest

from gdp import burst
from gdp.errors import DROP_COUNTERS, DropReason
from gdp.ports.mmsg import SLOTS, CompiledBatch, MmsgBatch, make_batch, send_failure
from gdp.sansio import ReceivedFrame

_BUILT = pytest.mark.skipif(burst.SYSTEM_CALLS is None, reason="the burst core in use has no compiled system calls")
KINDS = pytest.mark.parametrize("kind", [MmsgBatch, pytest.param(CompiledBatch, marks=_BUILT)])
MACS = bytes(range(12))
ETHER = MACS + b"\x88\xb5"

Pair = tuple[socket.socket, socket.socket]
Make = Callable[[int], MmsgBatch]


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


def fill(batch: MmsgBatch, frames: list[bytes]) -> None:
    """Write frames into the slots, as if they had been received."""
    for slot, frame in enumerate(frames):
        at = slot * batch.slot_bytes + len(ETHER)
        batch.pool[at : at + len(frame)] = frame
        batch._sizes[slot] = len(frame)


def no_drops() -> list[int]:
    return [0] * DROP_COUNTERS


@KINDS
def test_frames_leave_in_order_under_their_ethernet_header(kind: Make, pair: Pair) -> None:
    batch, drops = kind(200), no_drops()
    fill(batch, [b"one", b"", b"three"])
    assert batch.forward(pair[0], 0, 3, MACS, drops) == 3
    assert received(pair[1]) == [ETHER + b"one", ETHER, ETHER + b"three"]
    assert drops == no_drops()


@KINDS
def test_only_the_named_slots_leave(kind: Make, pair: Pair) -> None:
    batch = kind(200)
    fill(batch, [b"zero", b"one", b"two", b"three"])
    assert batch.forward(pair[0], 1, 2, MACS, no_drops()) == 2
    assert received(pair[1]) == [ETHER + b"one", ETHER + b"two"]


@KINDS
def test_what_is_taken_stands_in_its_slots_and_can_leave_again(kind: Make, pair: Pair) -> None:
    batch = kind(200)
    for frame in (b"first", b"second"):
        pair[1].send(bytes(14) + frame)
    assert batch.receive(pair[0]) == [5, 6]
    assert bytes(batch.pool[14:19]) == b"first"
    batch.pool[200 + 14] = ord("S")
    assert batch.forward(pair[0], 0, 2, MACS, no_drops()) == 2
    assert received(pair[1]) == [ETHER + b"first", ETHER + b"Second"]


@KINDS
def test_a_single_frame_leaves_whole_after_shorter_ones_were_taken(kind: Make, pair: Pair) -> None:
    batch = kind(200)
    for frame in (b"one", b"two"):
        pair[1].send(bytes(14) + frame)
    batch.receive(pair[0])
    pair[1].send(bytes(14) + b"a longer one")
    assert batch.receive(pair[0]) == [12]
    assert batch.forward(pair[0], 0, 1, MACS, no_drops()) == 1
    assert received(pair[1]) == [ETHER + b"a longer one"]


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
    assert kind(200).receive(pair[0]) == []


@KINDS
def test_at_most_a_batch_is_taken_at_once(kind: Make) -> None:
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with one, other:
        one.setblocking(False)
        batch, sizes = kind(200), []
        for _ in range(3):
            for _ in range(SLOTS // 2):
                other.send(bytes(20))
        while got := batch.receive(one):
            sizes.append(len(got))
    assert sizes == [SLOTS, SLOTS // 2]


@KINDS
def test_a_frame_longer_than_a_slot_arrives_cut_and_spoils_no_other(kind: Make, pair: Pair) -> None:
    batch = kind(64)
    pair[1].send(b"a" * 100)
    pair[1].send(b"b" * 20)
    assert batch.receive(pair[0]) == [50, 6]
    assert bytes(batch.pool[64 : 64 + 20]) == b"b" * 20


@KINDS
def test_a_full_queue_costs_the_frames_and_counts_them(kind: Make, pair: Pair) -> None:
    batch, drops, left = kind(200), no_drops(), 0
    fill(batch, [b"x"] * SLOTS)
    for _ in range(100):
        left += batch.forward(pair[0], 0, SLOTS, MACS, drops)
    assert left == len(received(pair[1]))
    assert drops[DropReason.PORT_FULL] == 100 * SLOTS - left > 0
    assert sum(drops) == drops[DropReason.PORT_FULL]


@KINDS
def test_a_sink_that_is_gone_counts_as_down(kind: Make, pair: Pair) -> None:
    batch, drops = kind(200), no_drops()
    fill(batch, [b"x", b"y"])
    pair[1].close()
    assert batch.forward(pair[0], 0, 2, MACS, drops) == 0
    assert drops[DropReason.PORT_DOWN] == 2


@KINDS
def test_one_frame_that_is_too_long_does_not_stop_the_others(kind: Make, pair: Pair) -> None:
    pair[0].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8_192)
    batch, drops = kind(65_000), no_drops()
    fill(batch, [b"a", bytes(60_000), b"b"])
    assert batch.forward(pair[0], 0, 3, MACS, drops) == 2
    assert received(pair[1]) == [ETHER + b"a", ETHER + b"b"]
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
