"""Progress of a run on standard error: a moving bar in a terminal, plain lines elsewhere. I/O."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.text import Text

from lab.command import StepDisplay

_PLAIN_EVERY_S: Final = 2.0
_RATED_S: Final = 0.4  # both sides report twice a second; a rate over a shorter time would fluctuate


@dataclass(frozen=True, slots=True, kw_only=True)
class Traffic:
    """State of the replay, combined from both sides.

    Args:
        total: number of expected messages and calls.
        lost: messages that a reader reports as permanently missing.
        behind: published or requested by the report before, and not yet delivered.
        silent: flows that stand still although they are behind, with seconds.
        latency_ms: one way, of the latest message; None before the first.
    """

    total: int = 0
    sent: int = 0
    received: int = 0
    lost: int = 0
    behind: int = 0
    silent: tuple[tuple[str, float], ...] = ()
    latency_ms: float | None = None

    def rate(self, before: Traffic, elapsed_s: float) -> float:
        """Return messages received a second since ``before``."""
        return (self.received - before.received) / elapsed_s if elapsed_s > 0 else 0.0

    def words(self, rate: float) -> str:
        """Return the figures as one line."""
        latency = "-" if self.latency_ms is None else f"{self.latency_ms:.1f} ms"
        words = f"{rate:5.0f} msg/s  published {self.sent}  delivered {self.received}  behind {self.behind}"
        words += f"  lost {self.lost}  latency {latency}"
        return words + "".join(f"  {flow} silent for {seconds:.0f} s" for flow, seconds in self.silent)


class ProgressReporter(StepDisplay):
    """Reports steps and traffic; ``console``: on standard error."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, is_kept=False, plain_every_s=_PLAIN_EVERY_S)
        columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.fields[words]}"))
        self._bar = Progress(*columns)
        self._task = self._bar.add_task("", words="")
        self._rated, self._rated_s = Traffic(), time.monotonic()

    def begin_traffic(self, total: int) -> None:
        """Begin the report of ``total`` messages."""
        self._rated, self._rated_s = Traffic(total=total), time.monotonic()
        self._bar.reset(self._task, total=total, words="")

    def traffic(self, now: Traffic) -> None:
        """Report the traffic so far; plain lines come at most every two seconds."""
        elapsed_s = time.monotonic() - self._rated_s
        if elapsed_s >= _RATED_S:
            words = now.words(now.rate(self._rated, elapsed_s))
            self._rated, self._rated_s = now, time.monotonic()
            self._bar.update(self._task, completed=now.received, words=words)
            self._show(self._bar.get_renderable(), Text(f"{now.received}/{now.total}  {words}"))
