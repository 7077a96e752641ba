"""Progress of a run on standard error: a moving bar in a terminal, plain lines elsewhere. I/O."""

from __future__ import annotations

import time
from dataclasses import dataclass
from types import TracebackType
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

_PLAIN_EVERY_S: Final = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Traffic:
    """State of the replay, combined from both sides.

    Args:
        total: number of expected messages and calls.
        lost: messages that a reader reports as permanently missing.
        behind: published or requested, and not yet delivered.
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


class ProgressReporter:
    """Reports steps and traffic; ``console``: on standard error."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bar: Progress | None = None
        self._task = TaskID(0)
        self._reported = Traffic()
        self._reported_s = time.monotonic()
        self._began_s = self._reported_s

    def __enter__(self) -> ProgressReporter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.end_traffic()

    def step(self, text: str) -> None:
        """Report the present step."""
        at = f"[dim]{time.monotonic() - self._began_s:6.1f} s[/dim]"
        self._console.print(f"{at}  {text}", highlight=False, soft_wrap=True)

    def begin_traffic(self, total: int) -> None:
        """Begin the report of ``total`` messages."""
        self._reported, self._reported_s = Traffic(total=total), time.monotonic()
        if self._console.is_terminal:
            columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.fields[words]}"))
            self._bar = Progress(*columns, console=self._console, transient=True)
            self._task = self._bar.add_task("", total=total, words="")
            self._bar.start()

    def traffic(self, now: Traffic) -> None:
        """Report the traffic so far; plain lines come at most every two seconds."""
        elapsed_s = time.monotonic() - self._reported_s
        if self._bar is not None:
            if elapsed_s >= 0.4:  # both sides report twice a second; a rate over a shorter time would fluctuate
                self._bar.update(
                    self._task, completed=now.received, words=now.words(now.rate(self._reported, elapsed_s))
                )
                self._reported, self._reported_s = now, time.monotonic()
        elif elapsed_s >= _PLAIN_EVERY_S:
            self.step(f"{now.received}/{now.total}  {now.words(now.rate(self._reported, elapsed_s))}")
            self._reported, self._reported_s = now, time.monotonic()

    def end_traffic(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
