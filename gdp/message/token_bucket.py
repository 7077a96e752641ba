"""Token bucket: a rate limit on what a peer may cause.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: RFC 2697, with one colour.
"""

from __future__ import annotations

from collections import OrderedDict

__all__ = ["Paces", "TokenBucket"]


class TokenBucket:
    """Tokens that refill at a rate, up to a burst; it starts full.

    Args:
        per_s: tokens per second.
        burst: largest number of tokens.
    """

    __slots__ = ("_burst", "_per_s", "_seen_s", "_tokens")

    def __init__(self, per_s: float, burst: float) -> None:
        self._per_s = per_s
        self._burst = burst
        self._tokens = burst
        self._seen_s = float("-inf")

    def spend(self, now_s: float, tokens: float = 1.0) -> bool:
        """Take tokens and return True, or return False and take none."""
        if now_s > self._seen_s:
            self._tokens = min(self._burst, self._tokens + (now_s - self._seen_s) * self._per_s)
            self._seen_s = now_s
        if self._tokens < tokens:
            return False
        self._tokens -= tokens
        return True


class Paces:
    """Token buckets by owner; of too many, the one that was used longest ago is forgotten.

    Args:
        per_s: tokens per second.
        burst: largest number of tokens of an owner.
        owners: largest number of buckets.
    """

    def __init__(self, per_s: float, burst: float, owners: int = 4_096) -> None:
        self._per_s = per_s
        self._burst = burst
        self._owners = owners
        self._buckets: OrderedDict[bytes, TokenBucket] = OrderedDict()

    def spend(self, owner: bytes, now_s: float, tokens: float = 1.0) -> bool:
        """Take an owner's tokens and return True, or return False and take none."""
        bucket = self._buckets.get(owner)
        if bucket is None:
            bucket = self._buckets[owner] = TokenBucket(self._per_s, self._burst)
            if len(self._buckets) > self._owners:
                self._buckets.popitem(last=False)
        self._buckets.move_to_end(owner)
        return bucket.spend(now_s, tokens)
