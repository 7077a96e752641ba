"""Waiting time between attempts to connect: exponential, with jitter.

Sans-I/O; randomness comes in. Source: RFC 6298, section 5.5 (doubling); the jitter keeps the members of one border
apart after the border restarts.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Backoff"]


@dataclass(slots=True, kw_only=True)
class Backoff:
    """Waiting times of one client.

    Args:
        first_s: of the first failure.
        longest_s: never more than this.
    """

    first_s: float = 0.1
    longest_s: float = 5.0
    _next_s: float = 0.0

    def failed(self, chance: float) -> float:
        """Return how many seconds to wait after a failure.

        Args:
            chance: in [0, 1), random; the wait is between half of the present step and all of it.
        """
        step_s = max(self._next_s, self.first_s)
        self._next_s = min(step_s * 2, self.longest_s)
        return step_s * (1 + chance) / 2

    def reset(self) -> None:
        """Begin again with the first waiting time: a connection stood, or the network has changed."""
        self._next_s = 0.0
