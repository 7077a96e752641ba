"""Send scheduler: of the publishers with data to send, urgent ones go first, the others in turn."""

from __future__ import annotations

from gdp.client.publisher import Publisher
from gdp.client.send_scheduler import BYTES_AT_ONCE, SendScheduler
from gdp.frame.codec import decode
from gdp.names import Name
from tests.gdp.client.pipe import Pipe, publisher_of


def read_by_one() -> Publisher:
    publisher = publisher_of()
    pipe = Pipe(publisher)
    pipe.join(b"a")
    pipe.run(1.0)
    return publisher


def test_two_floods_take_turns_and_a_small_message_waits_for_one_chunk_at_most() -> None:
    asked: list[Publisher] = []
    turns, publishers = SendScheduler(asked.append), [read_by_one() for _ in range(3)]
    for publisher, size in zip(publishers, (900_000, 900_000, 10), strict=True):
        publisher.published = turns.add
        publisher.publish(bytes(size))
    taken = [turns.poll_turn(101.0) for _ in range(3)]
    assert asked == [publishers[0], publishers[1], publishers[2], publishers[0]]
    assert all(sum(len(frame) for frames in each for frame in frames) <= 2 * BYTES_AT_ONCE for each in taken)


def test_a_publisher_that_has_no_more_is_not_asked_again_until_it_has() -> None:
    asked: list[Publisher] = []
    turns, publisher = SendScheduler(asked.append), read_by_one()
    publisher.published = turns.add
    assert not turns
    publisher.publish(b"one")
    assert turns
    (frames,) = turns.poll_turn(101.0)
    assert decode(frames[0]).destination == Name(b"t" * 32)
    assert not turns
    assert turns.poll_turn(101.0) == []
    assert asked == [publisher]
