"""Queue of the stream to all servers: it keeps its order, and a request waits no longer than its call."""

from __future__ import annotations

from gdp.service.dispatch import Ask, Stop
from gdp.service.frames import Stop as WireStop
from proxy.bridge.request_sender import BroadcastQueue, wire_of

FIRST, SECOND = Ask(1, b"first", None), Ask(2, b"second", None)


def test_what_waits_goes_in_its_order_and_once() -> None:
    waiting, stop = BroadcastQueue(), Stop((1, 2), None)
    for effect in (FIRST, SECOND, stop):
        waiting.add(0, effect)
    assert [waiting.poll_effect() for _ in range(len(waiting))] == [(0, FIRST), (0, SECOND), (0, stop)]


def test_the_request_of_a_call_that_ended_waits_no_longer() -> None:
    waiting = BroadcastQueue()
    for part in (0, 1):
        waiting.add(part, FIRST)
    waiting.end(0, FIRST.call)
    waiting.end(0, SECOND.call)
    assert (len(waiting), waiting.poll_effect()) == (1, (1, FIRST))


def test_a_request_travels_as_it_was_written_and_a_word_to_stop_with_its_part() -> None:
    assert wire_of(2, FIRST) == b"first"
    assert WireStop.from_wire(wire_of(2, Stop((1, 2), None))) == WireStop(2, (1, 2))
