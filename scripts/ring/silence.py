"""Silence detection: which reliable flows stand still, and for how long.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

REPORTED_FROM_S: Final = 1.5  # both ends report twice a second


@dataclass(slots=True)
class _Flow:
    sent: int = 0
    sent_before: int = 0  # by the report before; what was sent since then may be under way
    received: int = 0
    since_s: float = 0.0  # nothing was received since, although something was sent

    @property
    def is_behind(self) -> bool:
        return self.received < self.sent


class Silence:
    """A flow is silent while a sent message is outstanding and nothing is received."""

    def __init__(self) -> None:
        self._flows: dict[str, _Flow] = {}
        self.longest_s = 0.0

    @property
    def behind(self) -> int:
        """Return the number of messages, over all flows, that were sent by the report before and not received."""
        return sum(max(flow.sent_before - flow.received, 0) for flow in self._flows.values())

    def sent(self, name: str, count: int, now_s: float) -> None:
        """Set the total of sent messages of a flow."""
        flow = self._flows.setdefault(name, _Flow())
        if not flow.is_behind:
            flow.since_s = now_s
        flow.sent_before, flow.sent = flow.sent, count

    def received(self, name: str, count: int, now_s: float) -> None:
        """Set the total of received messages of a flow."""
        flow = self._flows.setdefault(name, _Flow())
        if flow.is_behind:
            self.longest_s = max(self.longest_s, now_s - flow.since_s)
        if count != flow.received:
            flow.received, flow.since_s = count, now_s

    def silent(self, now_s: float) -> list[tuple[str, float]]:
        """Return the flows that have been silent for ``REPORTED_FROM_S`` or longer, with seconds, longest first."""
        found = [
            (name, now_s - flow.since_s)
            for name, flow in self._flows.items()
            if flow.is_behind and now_s - flow.since_s >= REPORTED_FROM_S
        ]
        return sorted(found, key=lambda each: -each[1])
