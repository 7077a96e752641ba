"""Endpoint process of the priority bench at A, B and C: a member that ticks, floods, or reads.

Process of its own, started by ``priority.py``. A tick is a small message that carries the moment at which it was due. A
kernel timer wakes the process, as a robot's own loop would. Every delay before the tick leaves counts.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Mapping
from typing import Any, Final

from member_endpoint import PATIENCE_S, End, Timer, run_role
from peers.jsonl import say

from gdp.client.publisher import Publisher
from gdp.runtime.memory_tuning import tune_memory

__all__ = ["CONTROL", "IMAGES", "TICK_S"]

CONTROL: Final = "/control"
IMAGES: Final = "/images"
TICK_S: Final = 0.01
_TICK: Final = struct.Struct("!Bq91x")  # what it is, when it was due in ns; 100 bytes in all
_WARM_UP, _MEASURED, _LAST = range(3)
_WARM_UP_TICKS: Final = 50
_IMAGE_BYTES: Final = 921_600


class Ticks:
    """Publisher of a tick whenever one is due, from within the loop of the node."""

    def __init__(self, end: End, publisher: Publisher, count: int) -> None:
        self._publisher = publisher
        self._end = end
        self._count = _WARM_UP_TICKS + count
        self._sent = 0
        self._due_ns = time.monotonic_ns() + round(TICK_S * 1e9)
        self._timer = Timer(self._due_ns, TICK_S)
        end.plane.watch(self._timer, self._publish)

    @property
    def is_over(self) -> bool:
        """Return whether all are sent and acknowledged."""
        return self._sent >= self._count and self._publisher.is_acknowledged()

    def close(self) -> None:
        """Stop."""
        self._end.plane.unwatch(self._timer)
        self._timer.close()

    def _publish(self) -> None:
        for _ in range(min(self._timer.passed(), self._count - self._sent)):
            self._sent += 1
            what = _MEASURED if self._sent > _WARM_UP_TICKS else _WARM_UP
            if self._sent == self._count:
                what = _LAST
            self._publisher.publish(_TICK.pack(what, self._due_ns))
            self._due_ns += round(TICK_S * 1e9)


class Flood:
    """Publisher of images at the rate of the path.

    Args:
        kind: ``reliable`` or ``best-effort``; else nothing is published.
    """

    def __init__(self, end: End, kind: str) -> None:
        self._image = os.urandom(_IMAGE_BYTES)
        self._is_reliable = kind == "reliable"
        self.publisher = end.advertise(IMAGES, reliable=self._is_reliable) if kind in _FLOODS else None

    @property
    def is_ready(self) -> bool:
        """Return whether there is a reader, or nothing to read."""
        return self.publisher is None or self.publisher.readers > 0

    def go_on(self) -> None:
        """Keep something to send in the queue."""
        if self.publisher is None:
            return
        if self.publisher.has_space() if self._is_reliable else self.publisher.is_acknowledged():
            self.publisher.publish(self._image)


_FLOODS: Final = ("reliable", "best-effort")


def tick(end: End, settings: Mapping[str, Any]) -> None:
    """Run as A: tick, and flood if configured."""
    control = end.advertise(CONTROL, reliable=True, urgent=True)
    flood = Flood(end, str(settings["flood"]))
    tune_memory()
    if not end.runtime.run(lambda: control.readers > 0 and flood.is_ready, time.monotonic() + PATIENCE_S):
        raise TimeoutError("no reader: the overlay did not come up")
    seconds = float(settings["seconds"])
    ticks = Ticks(end, control, round(seconds / TICK_S))
    latest_s = time.monotonic() + seconds + PATIENCE_S
    while not ticks.is_over:
        if time.monotonic() > latest_s:
            raise TimeoutError("ticks were not acknowledged")
        flood.go_on()
        end.runtime.step(latest_s)
    ticks.close()
    say(event="over", repaired=control.repairs, drops=end.drops())
    end.leave()


def flood(end: End, settings: Mapping[str, Any]) -> None:
    """Run as C: flood until ended."""
    images = Flood(end, str(settings["flood"]))
    with end.runtime.signals():
        if not end.runtime.run(lambda: images.is_ready, time.monotonic() + PATIENCE_S):
            raise TimeoutError("no reader: the overlay did not come up")
        say(event="ready")
        while not end.runtime.is_stopped:
            images.go_on()
            end.runtime.step(time.monotonic() + PATIENCE_S)
        end.leave()


def read(end: End, _: Mapping[str, Any]) -> None:
    """Run as B: read both, and report at each last tick what arrived since the first measured one."""
    control = end.subscribe(CONTROL)
    end.subscribe(IMAGES)
    latencies_s: list[float] = []
    images, begun_s = 0, 0.0
    with end.runtime.signals():
        say(event="ready")
        while not end.runtime.is_stopped:
            end.runtime.step(time.monotonic() + PATIENCE_S)
            now_ns = time.monotonic_ns()
            for each in end.member.poll_messages():
                if each.topic != control:
                    images += 1
                    continue
                what, due_ns = _TICK.unpack(each.delivered.message)
                if what == _WARM_UP:
                    latencies_s, images, begun_s = [], 0, now_ns / 1e9
                    continue
                latencies_s.append((now_ns - due_ns) / 1e9)
                if what == _LAST:
                    say(latencies_s=latencies_s, images_s=images / (now_ns / 1e9 - begun_s), drops=end.drops())


if __name__ == "__main__":
    run_role({"tick": tick, "flood": flood, "read": read})
