"""Traffic of a run: what was sent and received, which flows stand still, and its report on standard error.

I/O of the reporter alone, by a moving bar in a terminal and plain lines elsewhere; otherwise sans-I/O, with time as
``now_s`` (monotonic seconds).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.text import Text

from lab.command import StepDisplay

REPORTED_FROM_S: Final = 1.5  # both ends report twice a second
_PLAIN_EVERY_S: Final = 2.0
_RATED_S: Final = 0.4  # a rate over a shorter time than that of a report would fluctuate


@dataclass(slots=True)
class _Flow:
    sent: int = 0
    sent_before: int = 0  # by the report before; what was sent since then may be under way
    received: int = 0
    since_s: float = 0.0  # nothing was received since, although something was sent

    @property
    def is_behind(self) -> bool:
        return self.received < self.sent


class Traffic:
    """Totals of all flows, by the reports of both sides. A flow is silent while a sent message is outstanding.

    Args:
        total: number of expected messages and calls.

    Attributes:
        lost: messages that a reader reports as permanently missing; they count as received by their flow.
        latency_ms: one way, of the latest message; None before the first.
        changes: how often a report was not that before.
        longest_s: the longest silence.
        label: of all flows in ``words``; empty: their names.
    """

    def __init__(self, total: int = 0) -> None:
        self.total = total
        self.lost = 0
        self.latency_ms: float | None = None
        self.changes = 0
        self.longest_s = 0.0
        self.label = ""
        self._flows: dict[str, _Flow] = {}

    @property
    def sent(self) -> int:
        """Return the number of sent messages."""
        return sum(flow.sent for flow in self._flows.values())

    @property
    def received(self) -> int:
        """Return the number of received messages."""
        return sum(flow.received for flow in self._flows.values()) - self.lost

    @property
    def behind(self) -> int:
        """Return the number of messages that were sent by the report before and not received."""
        return sum(max(flow.sent_before - flow.received, 0) for flow in self._flows.values())

    def note_sent(self, name: str, count: int, now_s: float) -> None:
        """Set the total of sent messages of a flow."""
        flow = self._flows.setdefault(name, _Flow())
        if not flow.is_behind:
            flow.since_s = now_s
        self.changes += count != flow.sent
        flow.sent_before, flow.sent = flow.sent, count

    def note_received(self, name: str, count: int, now_s: float) -> None:
        """Set the total of received messages of a flow."""
        flow = self._flows.setdefault(name, _Flow())
        if flow.is_behind:
            self.longest_s = max(self.longest_s, now_s - flow.since_s)
        if count != flow.received:
            flow.received, flow.since_s = count, now_s
            self.changes += 1

    def silent(self, now_s: float) -> list[tuple[str, float]]:
        """Return the flows that have been silent for ``REPORTED_FROM_S`` or longer, with seconds, longest first."""
        waits_s = {name: now_s - flow.since_s for name, flow in self._flows.items() if flow.is_behind}
        return sorted(((n, s) for n, s in waits_s.items() if s >= REPORTED_FROM_S), key=lambda each: -each[1])

    def words(self, rate: float, now_s: float) -> str:
        """Return the figures as one line; ``rate``: messages received a second."""
        latency = "-" if self.latency_ms is None else f"{self.latency_ms:.1f} ms"
        words = f"{rate:5.0f} msg/s  published {self.sent}  delivered {self.received}  behind {self.behind}"
        words += f"  lost {self.lost}  latency {latency}"
        return words + "".join(f"  {self.label or flow} silent for {s:.0f} s" for flow, s in self.silent(now_s))


class ProgressReporter(StepDisplay):
    """Reports steps and traffic; ``console``: on standard error."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, is_kept=False, plain_every_s=_PLAIN_EVERY_S)
        columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.fields[words]}"))
        self._bar = Progress(*columns)
        self._task = self._bar.add_task("", words="")
        self._rated, self._rated_s = 0, time.monotonic()

    def begin_traffic(self, total: int) -> None:
        """Begin the report of ``total`` messages."""
        self._rated, self._rated_s = 0, time.monotonic()
        self._bar.reset(self._task, total=total, words="")

    def traffic(self, now: Traffic) -> None:
        """Report the traffic so far; plain lines come at most every two seconds."""
        now_s = time.monotonic()
        if now_s - self._rated_s >= _RATED_S:
            words = now.words((now.received - self._rated) / (now_s - self._rated_s), now_s)
            self._rated, self._rated_s = now.received, now_s
            self._bar.update(self._task, completed=now.received, words=words)
            self._show(self._bar.get_renderable(), Text(f"{now.received}/{now.total}  {words}"))
