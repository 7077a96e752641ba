"""Token buckets: a rate limit on what a peer may cause.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: RFC 2697, with one colour.
"""

from __future__ import annotations

from collections import OrderedDict


class TokenBucket:
    """Tokens that refill at a rate, up to a burst; it starts full."""

    __slots__ = ("_burst", "_per_s", "_seen_s", "_tokens")

    def __init__(self, per_s: float, burst: float) -> None:
        self._per_s = per_s
        self._burst = burst
        self._tokens = burst
        self._seen_s = float("-inf")

    def left(self, now_s: float) -> float:
        """Return how many tokens there are; negative: they are owed."""
        if now_s > self._seen_s:
            self._tokens = min(self._burst, self._tokens + (now_s - self._seen_s) * self._per_s)
            self._seen_s = now_s
        return self._tokens

    def seconds_for(self, tokens: float) -> float:
        """Return how long so many tokens take to refill."""
        return max(tokens, 0.0) / self._per_s

    def spend(self, now_s: float, tokens: float = 1.0) -> bool:
        """Take tokens and return True, or return False and take none."""
        if self.left(now_s) < tokens:
            return False
        self._tokens -= tokens
        return True

    def change(self, now_s: float, per_s: float, burst: float) -> None:
        """Change the rate and the burst from now on; tokens above the new burst are gone."""
        self._tokens = min(self.left(now_s), burst)
        self._per_s, self._burst = per_s, burst

    def charge(self, now_s: float, tokens: float) -> None:
        """Take tokens, whether they are there or not; at most a full bucket is owed."""
        self._tokens = max(self.left(now_s) - tokens, -self._burst)


class TokenBuckets:
    """Token buckets by owner; of too many, the one that was used longest ago is forgotten."""

    def __init__(self, per_s: float, burst: float, maximum: int = 4_096) -> None:
        self._per_s = per_s
        self._burst = burst
        self._maximum = maximum
        self._buckets: OrderedDict[bytes, TokenBucket] = OrderedDict()

    def left(self, owner: bytes, now_s: float) -> float:
        """Return how many tokens an owner has."""
        bucket = self._buckets.get(owner)
        return self._burst if bucket is None else bucket.left(now_s)

    def spend(self, owner: bytes, now_s: float, tokens: float = 1.0) -> bool:
        """Take an owner's tokens and return True, or return False and take none."""
        return self._of(owner).spend(now_s, tokens)

    def charge(self, owner: bytes, now_s: float, tokens: float) -> None:
        """Take an owner's tokens, whether they are there or not; at most a full bucket is owed."""
        self._of(owner).charge(now_s, tokens)

    def _of(self, owner: bytes) -> TokenBucket:
        bucket = self._buckets.get(owner)
        if bucket is None:
            bucket = self._buckets[owner] = TokenBucket(self._per_s, self._burst)
            if len(self._buckets) > self._maximum:
                self._buckets.popitem(last=False)
        self._buckets.move_to_end(owner)
        return bucket
