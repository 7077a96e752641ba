"""Token buckets by key: a rate limit for each sender.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: RFC 2697, the committed bucket alone.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

__all__ = ["TokenBuckets"]

_KEYS_MAX: Final = 4_096


class TokenBuckets:
    """One bucket for each key; an unknown key has a full one.

    Args:
        per_s: tokens that come back each second.
        burst: tokens of a full bucket.
        maximum: buckets that are stored; the least recently used is removed first.
    """

    def __init__(self, per_s: float, burst: float, maximum: int = _KEYS_MAX) -> None:
        self._per_s = per_s
        self._burst = burst
        self._maximum = maximum
        self._buckets: OrderedDict[bytes, tuple[float, float]] = OrderedDict()  # tokens, and when they were counted

    def left(self, key: bytes, now_s: float) -> float:
        """Return how many tokens a key has."""
        known = self._buckets.get(key)
        if known is None:
            return self._burst
        tokens, at_s = known
        return min(tokens + max(now_s - at_s, 0.0) * self._per_s, self._burst)

    def spend(self, key: bytes, now_s: float, tokens: float = 1.0) -> bool:
        """Take tokens of a key; False, and none taken, where it has fewer."""
        left = self.left(key, now_s)
        if left < tokens:
            return False
        self._put(key, left - tokens, now_s)
        return True

    def charge(self, key: bytes, now_s: float, tokens: float) -> None:
        """Take tokens of a key, whether it has them or not; it owes at most a full bucket."""
        self._put(key, max(self.left(key, now_s) - tokens, -self._burst), now_s)

    def _put(self, key: bytes, tokens: float, now_s: float) -> None:
        self._buckets[key] = tokens, now_s
        self._buckets.move_to_end(key)
        if len(self._buckets) > self._maximum:
            self._buckets.popitem(last=False)
