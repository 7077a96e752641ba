"""Loop of a node: what still leaves after a signal has stopped it."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any, cast

import pytest

from gdp.ports.plane import Plane
from gdp.runtime.runtime import Runtime
from gdp.sansio import NodeCore, ReceivedFrame, Timestamps


class Core:
    """Core with frames to send, one at each call."""

    def __init__(self, frames: int) -> None:
        self.left = frames

    def frames_to_send(self, now_s: float) -> list[tuple[int, bytes, list[bytes]]]:
        del now_s
        self.left -= 1
        return [(1, b"", [b"frame"])] if self.left >= 0 else []

    def __getattr__(self, name: str) -> Any:
        del name
        return lambda *_: None

    def poll_neighbours(self) -> dict[int, frozenset[bytes]]:
        return {}


def loop(frames: int) -> tuple[Runtime, list[bytes]]:
    """Return a loop over a device that keeps what it sends, and those frames."""
    sent: list[bytes] = []

    def poll(timeout_s: float | None) -> list[ReceivedFrame]:
        time.sleep(min(timeout_s or 0.0, 0.001))
        return []

    plane = SimpleNamespace(
        ports={},
        frames_from=lambda _: 0,
        keepalives=None,
        on_link=lambda _: None,
        poll=poll,
        transmit=lambda port, mac, out: sent.extend(out),
    )
    return Runtime(cast(NodeCore, Core(frames)), cast(Plane, plane)), sent


def test_a_stopped_loop_still_sends_its_goodbye() -> None:
    runtime, sent = loop(3)
    runtime.stop()
    assert runtime.run()
    assert sent == []
    assert runtime.linger(time.monotonic() + 5, lambda: len(sent) == 3)


def test_another_stop_ends_the_wait() -> None:
    runtime, sent = loop(1)
    runtime.stop()

    def stopped() -> bool:
        if sent:
            runtime.stop()
        return False

    begun_s = time.monotonic()
    assert not runtime.linger(begun_s + 60, stopped)
    assert time.monotonic() < begun_s + 30


def test_the_wait_ends_with_its_time() -> None:
    runtime, _ = loop(0)
    assert not runtime.linger(time.monotonic() + 0.02)


def test_a_period_without_work_wakes_no_loop_and_its_function_is_called_once_there_is_some() -> None:
    runtime, _ = loop(0)
    work: list[str] = []
    runtime.every(0.0, lambda _now: work.clear(), lambda: work)
    assert runtime.next_due_s() is None
    work.append("a change")
    assert runtime.next_due_s() is not None
    runtime.step(time.monotonic())
    assert work == []


def test_periods_are_up_to_a_quarter_early_or_late_with_what_wakes_the_loop_and_are_kept_on_average() -> None:
    runtime, _ = loop(0)
    called: list[float] = []
    runtime.every(0.5, lambda moment: called.append(moment.mono_s))
    (each,) = runtime._periodic
    each.handle(Timestamps(100.0, 0.0))
    each.handle(Timestamps(100.2, 0.0))
    due_s, until_s = each.due_s, runtime.next_due_s()
    assert until_s == due_s + 0.125
    for now_s in (due_s - 0.13, due_s + 0.06, due_s + 0.3):
        each.handle(Timestamps(now_s, 0.0))
    assert called == [100.0, due_s + 0.06]
    assert each.due_s == due_s + 0.5
    each.handle(Timestamps(due_s + 0.4, 0.0))
    assert called[2:] == [due_s + 0.4]
    assert each.due_s == due_s + 1.0


def test_functions_of_several_periods_and_phases_share_their_wake_ups() -> None:
    runtime, _ = loop(0)
    calls: list[float] = []
    for period_s in (0.5, 1.0, 1.0):
        runtime.every(period_s, lambda _: calls.append(0.0))
    for each, begun_s in zip(runtime._periodic, (100.0, 100.13, 100.41), strict=True):
        each.handle(Timestamps(begun_s, 0.0))
    wakes = 0
    while (until_s := runtime.next_due_s()) is not None and until_s < 160.0:
        wakes += 1
        for each in runtime._periodic:
            each.handle(Timestamps(until_s, 0.0))
    assert len(calls) == pytest.approx(60 * 4, abs=6)
    assert wakes <= 60 / 0.5 + 4
