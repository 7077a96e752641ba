"""Endpoint process of the priority bench at A, B and C: a member that ticks, floods, or reads.

Process of its own, started by ``priority.py``. A tick is a small message that carries the moment at which it was due. A
kernel timer wakes the process, as a robot's own loop would. Every delay before the tick leaves counts. Source:
timerfd_create(2); CLOCK_MONOTONIC is one clock for all namespaces of a machine.
"""

from __future__ import annotations

import ctypes
import json
import os
import secrets
import struct
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from peers.jsonl import say

from gdp.client.participant import Participant, Topic
from gdp.client.publisher import Publisher
from gdp.control.settings import NodeSettings
from gdp.crypto.certificates import Role
from gdp.errors import DropReason, LocalError
from gdp.names import Name
from gdp.nodes.config import RibConfig
from gdp.nodes.membership import incarnation, load_member, wall_clock_ms
from gdp.nodes.memory_tuning import tune_memory
from gdp.nodes.runtime import Runtime
from gdp.ports.raw import RawPlane
from gdp.stores.keyring import load_delegations

__all__ = ["CONTROL", "IMAGES", "TICK_S", "main"]

CONTROL: Final = "/control"
IMAGES: Final = "/images"
TICK_S: Final = 0.01
_TICK: Final = struct.Struct("!Bq91x")  # what it is, when it was due in ns; 100 bytes in all
_WARM_UP, _MEASURED, _LAST = range(3)
_WARM_UP_TICKS: Final = 50
_IMAGE_BYTES: Final = 921_600
_PATIENCE_S: Final = 20.0

_LIBRARY: Final = ctypes.CDLL(None, use_errno=True)
_ABSOLUTE: Final = 1  # TFD_TIMER_ABSTIME
_SPEC: Final = struct.Struct("@qqqq")  # interval, first; each in seconds and nanoseconds


def _checked(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


class Timer:
    """Timer whose descriptor becomes readable at every tick.

    Raises:
        OSError: the kernel refuses.
    """

    def __init__(self, first_ns: int, every_s: float) -> None:
        self._fd = _checked(_LIBRARY.timerfd_create(time.CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC))
        spec = _SPEC.pack(0, round(every_s * 1e9), *divmod(first_ns, 1_000_000_000))
        _checked(_LIBRARY.timerfd_settime(self._fd, _ABSOLUTE, spec, None))

    def fileno(self) -> int:
        """Return its descriptor."""
        return self._fd

    def passed(self) -> int:
        """Return how many ticks were due since the last call."""
        return int.from_bytes(os.read(self._fd, 8), sys.byteorder)

    def close(self) -> None:
        """Stop it."""
        os.close(self._fd)


class End:
    """Member on its plane."""

    def __init__(self, config: Path, spin_s: float) -> None:
        settings = RibConfig.load(config)  # identity, domain and iface are all that an endpoint needs
        identity, policy = load_member(settings.identity, settings.domain, Role.PROXY)
        self.member = Participant(
            identity,
            policy,
            NodeSettings(incarnation=incarnation(), first_sequence=wall_clock_ms(), random_bytes=secrets.token_bytes),
        )
        self.plane = RawPlane([settings.iface])
        self.runtime = Runtime(self.member, self.plane, spin_s=spin_s)
        self._topics: dict[str, Topic] = {}
        for each in load_delegations(settings.identity / "delegations"):
            if each.metadata is None:
                raise LocalError("a delegation without metadata")
            grants = {epoch: grant.secret for epoch, grant in each.open(identity).items()}
            self._topics[str(each.metadata["name"])] = Topic(each, grants)

    def advertise(self, topic: str, *, reliable: bool, urgent: bool = False) -> Publisher:
        """Publish a topic."""
        return self.member.advertise(self._topics[topic], b"bench", reliable=reliable, urgent=urgent)

    def subscribe(self, topic: str) -> Name:
        """Read a topic; return its name."""
        self.member.subscribe(self._topics[topic])
        return self._topics[topic].name

    def drops(self) -> dict[str, int]:
        """Return what this process dropped, by reason."""
        of_member, of_plane = self.member.drops(), self.plane.counters.drops
        found = {reason.label: of_member.get(reason, 0) + of_plane[reason] for reason in DropReason}
        return {label: count for label, count in found.items() if count}

    def leave(self) -> None:
        """Withdraw and close."""
        self.member.leave()
        while self.runtime.send():
            continue


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


def tick(end: End, settings: Mapping[str, str | float]) -> None:
    """Run as A: tick, and flood if configured."""
    control = end.advertise(CONTROL, reliable=True, urgent=True)
    flood = Flood(end, str(settings["flood"]))
    tune_memory()
    if not end.runtime.run(lambda: control.readers > 0 and flood.is_ready, time.monotonic() + _PATIENCE_S):
        raise TimeoutError("no reader: the overlay did not come up")
    seconds = float(settings["seconds"])
    ticks = Ticks(end, control, round(seconds / TICK_S))
    latest_s = time.monotonic() + seconds + _PATIENCE_S
    while not ticks.is_over:
        if time.monotonic() > latest_s:
            raise TimeoutError("ticks were not acknowledged")
        flood.go_on()
        end.runtime.step(latest_s)
    ticks.close()
    say(event="over", repaired=control.repairs, drops=end.drops())
    end.leave()


def flood(end: End, settings: Mapping[str, str | float]) -> None:
    """Run as C: flood until ended."""
    images = Flood(end, str(settings["flood"]))
    with end.runtime.signals():
        if not end.runtime.run(lambda: images.is_ready, time.monotonic() + _PATIENCE_S):
            raise TimeoutError("no reader: the overlay did not come up")
        say(event="ready")
        while not end.runtime.is_stopped:
            images.go_on()
            end.runtime.step(time.monotonic() + _PATIENCE_S)
        end.leave()


def read(end: End) -> None:
    """Run as B: read both, and report at each last tick what arrived since the first measured one."""
    control = end.subscribe(CONTROL)
    end.subscribe(IMAGES)
    latencies_s: list[float] = []
    images, begun_s = 0, 0.0
    with end.runtime.signals():
        say(event="ready")
        while not end.runtime.is_stopped:
            end.runtime.step(time.monotonic() + _PATIENCE_S)
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


def main() -> None:
    """Run ``tick``, ``flood`` or ``read``, as the first argument states."""
    settings = json.loads(sys.argv[2])
    end = End(Path(settings["config"]), settings["spin_s"])
    if sys.argv[1] == "tick":
        tick(end, settings)
    elif sys.argv[1] == "flood":
        flood(end, settings)
    else:
        read(end)


if __name__ == "__main__":
    main()
