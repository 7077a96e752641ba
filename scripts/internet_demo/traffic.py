"""Traffic of the demonstration: images of a camera to two readers, and calls of a service, each with its account.

Threads of this process; the counts may be read at any time.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Final

import gdp
from lab.internet.flow import NumberedFlow

CAMERA: Final = "/camera/image"
PLAN: Final = "/plan"
_CALL_S: Final = 30.0
_AT_ONCE: Final = 64
_PATIENCE_S: Final = 60.0


@dataclass(slots=True)
class Calls:
    """What the calls came to."""

    begun: int = 0
    answered: int = 0
    failed: int = 0
    reasons: Counter[str] = field(default_factory=Counter)


class Traffic:
    """All traffic.

    ``robot``: publishes and calls. ``server``: serves the calls, and reads. ``readers``: sessions that read, by label.
    """

    def __init__(
        self,
        robot: gdp.Session,
        server: gdp.Session,
        readers: Mapping[str, gdp.Session],
        rate_hz: float,
        image_bytes: int,
    ) -> None:
        self._robot = robot
        self._labels = tuple(readers)
        self.calls = Calls()
        self._over = threading.Event()
        self._period_s = 1 / rate_hz
        server.serve(PLAN, lambda request: request.payload)
        subscriptions = [session.subscribe(CAMERA, queue=10_000) for session in readers.values()]
        self._pool = ThreadPoolExecutor(_AT_ONCE)
        robot.call(PLAN, b"first", timeout_s=_PATIENCE_S)
        publisher = robot.publisher(CAMERA)
        publisher.wait_for_readers(len(readers), _PATIENCE_S)
        self.images = NumberedFlow(publisher, *subscriptions, hz=rate_hz, size=image_bytes)
        self._caller = threading.Thread(target=self._call_all, name="caller")
        self._caller.start()

    def end(self) -> None:
        """End all traffic; return when everything is settled."""
        self._over.set()
        self._caller.join()
        self._pool.shutdown()
        self.images.close()

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of images that each reader got."""
        return {label: len(each) for label, each in zip(self._labels, self.images.arrivals, strict=True)}

    @property
    def lost(self) -> int:
        """Number of images that a reader did not get, and of calls that failed."""
        return self.images.lost + self.calls.failed

    def _call_all(self) -> None:
        due_s = time.monotonic()
        while not self._over.wait(max(due_s - time.monotonic(), 0.0)):
            due_s += self._period_s
            self.calls.begun += 1
            self._pool.submit(self._call, str(self.calls.begun).encode())

    def _call(self, request: bytes) -> None:
        try:
            response = self._robot.call(PLAN, request, timeout_s=_CALL_S)
        except gdp.SessionError as error:
            self.calls.failed += 1
            self.calls.reasons[str(error)] += 1
            return
        self.calls.answered += response.payload == request
        self.calls.failed += response.payload != request
