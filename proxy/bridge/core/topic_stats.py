"""Statistics of the topics that a proxy receives."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Final

from gdp.message.loss import Losses

SAMPLES_MAX: Final = 200_000  # latencies kept for percentiles; the oldest go


@dataclass(slots=True, kw_only=True)
class TopicStats:
    """Statistics of one topic."""

    topic: str
    type_name: str
    received: int = 0
    received_bytes: int = 0  # in the endpoint's wire form
    losses: Losses = field(default_factory=Losses)  # on the overlay
    duplicated: int = 0
    refused: int = 0  # arrived, but could not be passed to the endpoint
    parts: int = 0  # largest number of fragments of a message
    hops: Counter[int] = field(default_factory=Counter)
    latencies_ms: deque[float] = field(default_factory=lambda: deque(maxlen=SAMPLES_MAX))
    newest: dict[tuple[bytes, int], tuple[int, int]] = field(default_factory=dict)
    # publisher, incarnation -> message number, position in its bundle

    @property
    def lost(self) -> int:
        """Return the number of messages that did not reach the endpoint: lost on the way, or refused here."""
        return self.losses.total + self.refused

    def count_number(self, publisher: bytes, incarnation: int, number: int, place: int = 0) -> None:
        """Count a message that arrived again: numbers rise within an incarnation, positions within a bundle."""
        incarnation_id, at = (publisher, incarnation), (number, place)
        newest = self.newest.get(incarnation_id, (-1, 0))
        self.duplicated += at <= newest
        self.newest[incarnation_id] = max(at, newest)

    def add(self, latency_ms: float, parts: int, hops: int, size: int = 0) -> None:
        """Count one message of this many bytes."""
        self.received += 1
        self.received_bytes += size
        self.latencies_ms.append(latency_ms)
        self.parts = max(self.parts, parts)
        self.hops[hops] += 1

    def to_fields(self) -> dict[str, object]:
        """Return the statistics as one JSON object."""
        ordered = sorted(self.latencies_ms)
        latency = {"median": percentile(ordered, 0.5), "p99": percentile(ordered, 0.99), "max": percentile(ordered, 1)}
        return {
            "topic": self.topic,
            "type": self.type_name,
            "received": self.received,
            "lost": self.lost,
            "lost_by_reason": self.losses.by_label(),
            "losses": self.losses.to_fields(),
            "duplicated": self.duplicated,
            "refused": self.refused,
            "latency_ms": latency,
            "parts": self.parts,
            "hops": self.hops.most_common(1)[0][0] if self.hops else 0,
            "hops_seen": sorted(self.hops),
        }


def percentile(ordered: list[float], share: float) -> float | None:
    """Return the value below which a share (0 to 1) of sorted values lies, by nearest rank; None if there are none."""
    if not ordered:
        return None
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)]
