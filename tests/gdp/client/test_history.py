"""History of a latched topic: what late joiners get, bounded by messages, bytes and age."""

from __future__ import annotations

import pytest

from gdp.client.publisher import Publisher
from gdp.client.send_options import SendOptions
from tests.gdp.client.pipe import Pipe, publisher_of

SIZE = 1_000


def message(number: int) -> bytes:
    return number.to_bytes(4, "big") * (SIZE // 4)


def piped(depth: int, **bounds: float | None) -> tuple[Publisher, Pipe]:
    publisher = publisher_of(depth=depth, options=SendOptions(**bounds))  # type: ignore[arg-type]
    return publisher, Pipe(publisher)


def publish(publisher: Publisher, pipe: Pipe, numbers: range) -> None:
    for number in numbers:
        publisher.publish(message(number), pipe.now_s)


def numbers_of(pipe: Pipe, name: bytes) -> list[int]:
    """Return what a reader gets that joins now."""
    late = pipe.join(name)
    pipe.run(10.0)
    return [int.from_bytes(each[:4], "big") for each in late.messages]


@pytest.mark.parametrize("has_reader", [True, False])
def test_a_late_joiner_gets_thousands_of_messages(*, has_reader: bool) -> None:
    publisher, pipe = piped(2_000)
    if has_reader:
        pipe.join(b"a")
        pipe.run(1.0)
    publish(publisher, pipe, range(2_500))
    pipe.run(5.0)
    assert numbers_of(pipe, b"b") == list(range(500, 2_500))


@pytest.mark.parametrize("has_reader", [True, False])
def test_bytes_bound_what_is_kept(*, has_reader: bool) -> None:
    publisher, pipe = piped(2_000, history_bytes=50 * SIZE)
    if has_reader:
        pipe.join(b"a")
        pipe.run(1.0)
    publish(publisher, pipe, range(500))
    pipe.run(5.0)
    got = numbers_of(pipe, b"b")
    assert 30 <= len(got) <= 50
    assert got == list(range(500 - len(got), 500))


@pytest.mark.parametrize("has_reader", [True, False])
def test_age_bounds_what_is_kept(*, has_reader: bool) -> None:
    publisher, pipe = piped(2_000, history_age_s=20.0)
    if has_reader:
        pipe.join(b"a")
        pipe.run(1.0)
    publish(publisher, pipe, range(10))
    pipe.run(15.0)
    publish(publisher, pipe, range(10, 15))
    pipe.run(10.0)
    assert numbers_of(pipe, b"b") == list(range(10, 15))


def test_old_messages_stay_for_a_reader_that_still_lacks_them() -> None:
    publisher, pipe = piped(2_000, history_age_s=0.5, history_bytes=10 * SIZE)
    reader = pipe.join(b"a")
    pipe.run(1.0)
    publish(publisher, pipe, range(200))
    pipe.run(10.0)
    assert len(reader.messages) == 200
    assert publisher.drops.total() == 0


def test_what_is_kept_is_bounded_in_memory() -> None:
    publisher, pipe = piped(100_000, history_bytes=100 * SIZE)
    pipe.join(b"a")
    pipe.run(1.0)
    for begin in range(0, 2_000, 100):
        publish(publisher, pipe, range(begin, begin + 100))
        pipe.run(1.0)
    assert publisher._window.cache.held_bytes <= 100 * SIZE
