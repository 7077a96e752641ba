"""Statistics of ``gdp ping``: loss and round-trip times of one member.

Sans-I/O.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil

__all__ = ["PingStatistics", "quantile"]


@dataclass(slots=True)
class PingStatistics:
    """Requests to one member, and their round-trip times in milliseconds."""

    sent: int = 0
    rtts_ms: list[float] = field(default_factory=list)

    @property
    def loss(self) -> float:
        """Return the share of requests without a reply, 0 to 1."""
        return 1 - len(self.rtts_ms) / self.sent if self.sent else 0.0

    def to_fields(self) -> dict[str, object]:
        """Return the JSON fields; round-trip times are None where nothing came back."""
        times = sorted(self.rtts_ms)
        return {
            "sent": self.sent,
            "received": len(times),
            "loss": round(self.loss, 4),
            "min_ms": times[0] if times else None,
            "median_ms": quantile(times, 0.5),
            "p99_ms": quantile(times, 0.99),
            "max_ms": times[-1] if times else None,
        }

    def to_text(self) -> str:
        """Return the summary for people."""
        times = sorted(self.rtts_ms)
        counts = f"{self.sent} sent, {len(times)} received, {100 * self.loss:.3g} % lost"
        if not times:
            return counts
        median, p99 = quantile(times, 0.5), quantile(times, 0.99)
        return f"{counts}, min/median/p99/max {times[0]:.2f}/{median:.2f}/{p99:.2f}/{times[-1]:.2f} ms"


def quantile(times: list[float], share: float) -> float | None:
    """Return the smallest value that at least this share of the sorted values does not exceed; None: there are none."""
    return times[max(ceil(share * len(times)) - 1, 0)] if times else None
