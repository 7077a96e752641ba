"""Pace of responses to local clients, so that none is lost in a short queue.

Sans-I/O, except that it passes responses to the endpoint. ROS 2 gives a client a queue of ten responses by default
(``rmw_qos_profile_services_default``), and drops the oldest ones of more. After a stall of a machine or of a path, all
responses come at once. The first few are passed on immediately, the others at a rate that a busy node can take.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Final

from gdp.intervals import Rate
from gdp.token_bucket import TokenBucket
from proxy.endpoints.core.endpoint import RosEndpoint

_LEAST_RATE: Final = Rate(200.0, burst=5)  # a busy node may not run for 25 ms
_MEASURED_S: Final = 1.0  # time over which the rate of requests is measured
_ROUNDING: Final = 1e-6  # of a token, at the very time that the timer gave
_HEADROOM: Final = 2.0  # responses leave at least so many times as fast as the requests came


class LocalResponses:
    """Responses to the local clients of one service, in order.

    Args:
        is_paced: whether the clients have short queues; else ``flush`` passes on everything.

    Attributes:
        last_s: monotonic second at which ``flush`` last passed on a response; minus infinity: it did not yet.
    """

    def __init__(self, endpoint: RosEndpoint, *, is_paced: bool) -> None:
        self._endpoint = endpoint
        self._is_paced = is_paced
        self._waiting: deque[Callable[[], None]] = deque()
        self._bucket = TokenBucket(*_LEAST_RATE)
        self._requests, self._since_s = 0, float("-inf")
        self.last_s = float("-inf")

    def __len__(self) -> int:
        return len(self._waiting)

    def handle_request(self, now_s: float) -> None:
        """Count a client's request: clients that make many take many responses."""
        took_s = now_s - self._since_s
        if took_s >= _MEASURED_S:
            per_s = max(_LEAST_RATE.per_s, _HEADROOM * self._requests / took_s)
            self._bucket.change(now_s, per_s, _LEAST_RATE.burst)
            self._requests, self._since_s = 0, now_s
        self._requests += 1

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        """Queue a response for ``flush``."""
        self._waiting.append(partial(self._endpoint.answer, handle, ticket, raw))

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        """Queue the reason of a failure in place of a response, for ``flush``."""
        self._waiting.append(partial(self._endpoint.refuse, handle, ticket, reason))

    def flush(self, now_s: float) -> None:
        """Pass on the responses whose time has come."""
        while self._waiting and (not self._is_paced or self._bucket.left(now_s) > 1.0 - _ROUNDING):
            self._bucket.charge(now_s, 1.0)
            self._waiting.popleft()()
            self.last_s = now_s

    def flush_all(self) -> None:
        """Pass on all responses now, because the clients' server ends."""
        while self._waiting:
            self._waiting.popleft()()

    def get_timer(self, now_s: float) -> float | None:
        """Return the monotonic second at which the next response may be passed on, or None."""
        if not self._waiting:
            return None
        return now_s + self._bucket.seconds_for(1.0 - self._bucket.left(now_s))
