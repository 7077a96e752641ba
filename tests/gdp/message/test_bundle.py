"""Several messages under one seal: exact, or refused whole; and the number of messages under each sequence number."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import FrameError
from gdp.message.bundle import BUNDLE_MAX_BYTES, Gathered, pack, unpack


@given(st.lists(st.binary(max_size=40), min_size=1, max_size=20))
def test_what_was_packed_comes_out_in_order(messages: list[bytes]) -> None:
    assert unpack(pack(messages)) == messages


@given(st.binary(max_size=80))
def test_arbitrary_bytes_are_a_bundle_to_the_last_byte_or_refused(wire: bytes) -> None:
    try:
        messages = unpack(wire)
    except FrameError:
        return
    assert messages
    assert pack(messages) == wire


@pytest.mark.parametrize(
    "wire",
    [
        b"",
        b"\0\0\0",
        pack([b"one"]) + b"\0",
        pack([b"one", b"two"])[:-1],
        pack([b"one"]) + b"\xff\xff\xff\xff",
        bytes(BUNDLE_MAX_BYTES + 4),
    ],
    ids=["empty", "half a length", "trailing byte", "cut", "a length beyond the end", "above the limit"],
)
def test_what_is_not_exact_is_refused(wire: bytes) -> None:
    with pytest.raises(FrameError):
        unpack(wire)


def test_waiting_messages_go_together_in_order_as_far_as_they_fit() -> None:
    gathered = Gathered()
    messages = [bytes([at]) * 100 for at in range(10)]
    for message in messages:
        gathered.add(1, message)
    first, second = gathered.poll_batch(4 * 104)[0], gathered.poll_batch(4 * 104 + 50)[0]
    assert [*first, *second] == messages[:8]
    assert len(gathered.messages) == 2


def test_a_message_that_no_longer_fits_goes_alone() -> None:
    gathered = Gathered()
    gathered.add(1, bytes(100))
    gathered.add(1, bytes(100))
    assert gathered.poll_batch(50)[0] == [bytes(100)]


def test_all_that_was_held_is_given_back() -> None:
    gathered = Gathered()
    for size in (0, 1, 1_000):
        gathered.add(1, bytes(size))
    held_bytes = gathered.held_bytes
    while gathered.messages:
        gathered.poll_batch(0)
    assert held_bytes > 1_001
    assert gathered.held_bytes == 0
