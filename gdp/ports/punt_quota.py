"""Rate limit for frames that may arrive in floods: so many frames a second, beyond which a socket pauses.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: a leaky bucket as a meter (ITU-T I.371), charged after
the fact, because a batch is read before its size is known.
"""

from __future__ import annotations

__all__ = ["PuntQuota"]


class PuntQuota:
    """The remaining quota of one source of frames.

    Args:
        rate: frames a second.
        burst: frames at once.
    """

    __slots__ = ("_at_s", "_burst", "_left", "_rate")

    def __init__(self, rate: float, burst: float, now_s: float) -> None:
        self._rate = rate
        self._burst = self._left = burst
        self._at_s = now_s

    def charge(self, frames: int, now_s: float) -> float:
        """Charge frames; return the seconds to pause, 0 while some quota is left."""
        self._left = min(self._left + (now_s - self._at_s) * self._rate, self._burst) - frames
        self._at_s = now_s
        return max(-self._left, 0.0) / self._rate
