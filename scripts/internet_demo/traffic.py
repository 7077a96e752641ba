"""Traffic of the demonstration: images of a camera to two readers, and calls of a service, each with its account.

Threads of this process; the counts may be read at any time.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Final

import gdp

CAMERA: Final = "/camera/image"
PLAN: Final = "/plan"
_NUMBER_BYTES: Final = 8
_CALL_S: Final = 30.0
_AT_ONCE: Final = 64
_PATIENCE_S: Final = 60.0


@dataclass(slots=True)
class Reader:
    """What one reader got."""

    label: str
    counts: Counter[int] = field(default_factory=Counter)
    last_s: float = 0.0
    longest_s: float = 0.0  # between two images, since the last reset

    def take(self, number: int, now_s: float) -> None:
        """Record an image."""
        self.counts[number] += 1
        if self.last_s:
            self.longest_s = max(self.longest_s, now_s - self.last_s)
        self.last_s = now_s

    @property
    def doubled(self) -> int:
        """Number of images that came more than once."""
        return sum(self.counts.values()) - len(self.counts)

    def lost(self, sent: int) -> int:
        """Return how many of the images 1 to ``sent`` did not come."""
        return sent - sum(1 for number in self.counts if number <= sent)


@dataclass(slots=True)
class Calls:
    """What the calls came to."""

    begun: int = 0
    answered: int = 0
    failed: int = 0
    reasons: Counter[str] = field(default_factory=Counter)


class Camera:
    """Publisher of images at a rate, in a thread."""

    def __init__(self, session: gdp.Session, rate_hz: float, image_bytes: int, readers: int) -> None:
        self._publisher = session.publisher(CAMERA)
        self._publisher.wait_for_readers(readers, _PATIENCE_S)
        self._period_s = 1 / rate_hz
        self._body = bytes(image_bytes - _NUMBER_BYTES)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera")
        self.sent = 0
        self._thread.start()

    def end(self) -> None:
        """Publish no more; return when the readers have confirmed everything, or after a minute."""
        self._over.set()
        self._thread.join()
        self._publisher.flush(_PATIENCE_S)

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._over.wait(max(due_s - time.monotonic(), 0.0)):
            due_s += self._period_s
            self._publisher.put((self.sent + 1).to_bytes(_NUMBER_BYTES, "big") + self._body)
            self.sent += 1


class Traffic:
    """All traffic; a context manager that closes what it opened.

    ``robot``: publishes and calls. ``server``: serves the calls, and reads. ``readers``: sessions that read, by label.
    """

    def __init__(
        self, robot: gdp.Session, server: gdp.Session, readers: dict[str, gdp.Session], rate_hz: float, image_bytes: int
    ) -> None:
        self._robot = robot
        self.readers = {label: Reader(label) for label in readers}
        self.calls = Calls()
        self._stack = ExitStack()
        self._over = threading.Event()
        self._period_s = 1 / rate_hz
        server.serve(PLAN, lambda request: request.payload)
        for label, session in readers.items():
            subscription = session.subscribe(CAMERA, queue=10_000)
            threading.Thread(target=self._read, args=(subscription, self.readers[label]), daemon=True).start()
        self._pool = ThreadPoolExecutor(_AT_ONCE)
        robot.call(PLAN, b"first", timeout_s=_PATIENCE_S)
        self.camera = Camera(robot, rate_hz, image_bytes, len(readers))
        self._caller = threading.Thread(target=self._call_all, name="caller")
        self._caller.start()

    def end(self) -> None:
        """End all traffic; return when everything is settled."""
        self._over.set()
        self._caller.join()
        self._pool.shutdown()
        self.camera.end()
        deadline_s = time.monotonic() + _PATIENCE_S
        while time.monotonic() < deadline_s and any(each.lost(self.camera.sent) for each in self.readers.values()):
            time.sleep(0.05)

    @property
    def lost(self) -> int:
        """Number of images that a reader did not get, and of calls that failed."""
        return sum(each.lost(self.camera.sent) for each in self.readers.values()) + self.calls.failed

    def reset_pauses(self) -> None:
        """Begin to measure the longest pauses again."""
        for each in self.readers.values():
            each.longest_s = 0.0

    @staticmethod
    def _read(subscription: gdp.Subscription, reader: Reader) -> None:
        for message in subscription:
            reader.take(int.from_bytes(message.payload[:_NUMBER_BYTES], "big"), time.monotonic())

    def _call_all(self) -> None:
        due_s = time.monotonic()
        while not self._over.wait(max(due_s - time.monotonic(), 0.0)):
            due_s += self._period_s
            self.calls.begun += 1
            self._pool.submit(self._call, self.calls.begun.to_bytes(_NUMBER_BYTES, "big"))

    def _call(self, request: bytes) -> None:
        try:
            response = self._robot.call(PLAN, request, timeout_s=_CALL_S)
        except gdp.SessionError as error:
            self.calls.failed += 1
            self.calls.reasons[str(error)] += 1
            return
        self.calls.answered += response.payload == request
        self.calls.failed += response.payload != request
