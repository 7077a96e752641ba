"""IPC between the proxy and its rospy process."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from proxy.endpoints.ros1.ipc import Frame, IpcLink, Kind, LinkEndedError

Pair = tuple[IpcLink, IpcLink, list[int]]


def paired(budget_bytes: int = 1 << 20) -> Pair:
    behind: list[int] = []
    left, right = socket.socketpair()
    return IpcLink(left, lambda: behind.append(1), budget_bytes=budget_bytes), IpcLink(right, lambda: None), behind


@pytest.fixture
def pair() -> Iterator[Pair]:
    pair = paired()
    yield pair
    pair[0].close()
    pair[1].close()


def everything(sender: IpcLink, receiver: IpcLink) -> list[Frame]:
    frames: list[Frame] = []
    while True:
        was_behind = sender.is_behind
        some = receiver.poll_frames()
        sender.flush()
        if not some and not was_behind:
            return frames
        frames += some


@settings(max_examples=50, deadline=None)
@given(st.lists(st.one_of(st.integers(0, 300), st.integers(60_000, 140_000), st.just(1_000_000)), max_size=20))
def test_frames_of_any_size_arrive_whole_and_in_order(sizes: list[int]) -> None:
    sender, receiver, _ = paired(1 << 30)
    sent = [Frame(Kind.HEARD, index, index << 33, bytes([index]) * size) for index, size in enumerate(sizes)]
    for frame in sent:
        assert sender.send(*frame)
    assert everything(sender, receiver) == sent
    sender.close()
    receiver.close()


def test_a_full_link_drops_the_oldest_message_of_that_topic_only(pair: Pair) -> None:
    sender, receiver, behind = pair
    assert sender.send(Kind.HEARD, 1, 0, bytes(400_000))  # part of it is in flight
    assert behind == [1]
    for number in range(1, 10):
        assert sender.send(Kind.HEARD, 2, number, bytes(100))
        assert sender.send(Kind.HEARD, 3, number, bytes(200_000))
    assert sender.send(Kind.CLOSE, 4)
    frames = everything(sender, receiver)
    assert [frame.number for frame in frames if frame.handle == 2] == list(range(1, 10))
    kept = [frame.number for frame in frames if frame.handle == 3]
    assert kept == list(range(10 - len(kept), 10))
    assert sender.dropped == 9 - len(kept) > 0
    assert frames[0].payload == bytes(400_000)
    assert frames[-1].kind is Kind.CLOSE


def test_a_request_beyond_the_capacity_is_not_taken(pair: Pair) -> None:
    sender, receiver, _ = pair
    assert sender.send(Kind.CALL, 1, 1, bytes(900_000))
    assert sender.send(Kind.CALL, 1, 2, bytes(300_000))
    assert not sender.send(Kind.CALL, 1, 3, bytes(900_000))
    assert sender.send(Kind.ANSWER, 1, 4, bytes(900_000))
    assert [frame.number for frame in everything(sender, receiver)] == [1, 2, 4]


def test_nothing_is_remembered_of_what_was_sent(pair: Pair) -> None:
    sender, receiver, _ = pair
    for _ in range(20):
        for handle in range(50):
            sender.send(Kind.PUBLISH, handle, 0, bytes(10_000))
        everything(sender, receiver)
    assert (sender.is_behind, sender._waiting_bytes, dict(sender._topics)) == (False, 0, {})


def test_the_end_is_reported_after_the_last_frame(pair: Pair) -> None:
    sender, receiver, _ = pair
    sender.send(Kind.ENDING, payload=b"why")
    sender.close()
    assert receiver.poll_frames() == [Frame(Kind.ENDING, 0, 0, b"why")]
    with pytest.raises(LinkEndedError):
        receiver.poll_frames()
    assert receiver.send(Kind.CLOSE, 1)
