"""Virtual server: what local clients see in place of the remote servers of one service or action.

I/O through the endpoint. The virtual server exists while a remote server is reachable. When the last one goes, it stays
for a moment: a middleware drops a response that its client has not received when the server ends. Fast DDS and Cyclone
DDS do so, and a busy client's process may not run for a while. Requests that come in this time are refused.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Final

from gdp.due_queue import earliest
from gdp.intervals import Rate
from gdp.token_bucket import TokenBucket
from proxy.bridge.core.action_interface import PROFILES
from proxy.bridge.service_flow import ServiceFlow
from proxy.endpoints.core.endpoint import RosEndpoint
from proxy.wire.service import Exchange

_LEAST_RATE: Final = Rate(200.0, burst=5)  # a busy node may not run for 25 ms
_MEASURED_S: Final = 1.0  # time over which the rate of requests is measured
_ROUNDING: Final = 1e-6  # of a token, at the very time that the timer gave
_HEADROOM: Final = 2.0  # responses leave at least so many times as fast as the requests came
_STAYS_S: Final = 0.25  # after the last response; a second is long enough for clients to take it for a new server


class VirtualServer:
    """Server and an action's topics in one graph; opened and closed any number of times.

    Args:
        flow: owner of its events.
    """

    def __init__(self, flow: ServiceFlow) -> None:
        self._dispatcher = flow.dispatcher
        self._owner = flow
        endpoint = flow.dispatcher.endpoint
        self._responses = LocalResponses(endpoint, is_paced=flow.flow_spec.has_short_queues(endpoint.ros))
        self._services: list[int] = []  # handles
        self._topics: list[int] = []
        self._closing: list[int] = []  # handles of both
        self._ends_s: float | None = None  # when those are closed; None: a response still waits

    def open(self, exchange: Exchange) -> None:
        """Create the server and the topics of a description."""
        self._end_closing()  # two servers of one name would both be asked
        self._topics = [
            self._dispatcher.advertise(
                self._owner, replace(each, qos=(profile,), latched=profile.durability == "transient_local")
            )
            for each, profile in zip(exchange.topics, PROFILES, strict=False)
        ]
        self._services = [self._dispatcher.serve(self._owner, each) for each in exchange.services]

    def close(self) -> None:
        """Serve no client from now on; ``flush`` ends the server when clients have received their responses."""
        self._closing += [*self._services, *self._topics]
        self._services, self._topics = [], []

    def close_now(self) -> None:
        """Pass on all responses, and end the server."""
        self.close()
        self._end_closing()

    def handle_request(self, handle: int, now_s: float) -> int | None:
        """Count a client's request; return the number of its service within the description, None: it closes."""
        self._responses.handle_request(now_s)
        return self._services.index(handle) if handle in self._services else None

    def answer(self, handle: int, ticket: int, raw: bytes) -> None:
        """Queue a response for ``flush``."""
        self._responses.answer(handle, ticket, raw)

    def refuse(self, handle: int, ticket: int, reason: str) -> None:
        """Queue the reason of a failure in place of a response, for ``flush``."""
        self._responses.refuse(handle, ticket, reason)

    def publish(self, at: int, raw: bytes) -> None:
        """Publish a message of a topic of an action, -1: its last; dropped where the server is closed."""
        if self._topics:
            self._dispatcher.endpoint.publish(self._topics[at], raw)

    def flush(self, now_s: float) -> None:
        """Pass on the responses whose time has come; end a closed server whose clients have had time for them."""
        self._responses.flush(now_s)
        if self._closing and self._ends_s is None and not self._responses:
            self._ends_s = self._responses.last_s + _STAYS_S  # requests that are refused meanwhile do not delay it
        if self._ends_s is not None and now_s >= self._ends_s:
            self._end_closing()

    def get_timer(self, now_s: float) -> float | None:
        """Return the monotonic second at which ``flush`` has something to do, or None."""
        return earliest(self._responses.get_timer(now_s), self._ends_s)

    def _end_closing(self) -> None:
        self._responses.flush_all()
        for handle in self._closing:
            self._dispatcher.close(handle)
        self._closing, self._ends_s = [], None


class LocalResponses:
    """Responses to the local clients of one service, in order and paced, so that none is lost in a short queue.

    ROS 2 gives a client a queue of ten responses by default (``rmw_qos_profile_services_default``), and drops the
    oldest ones of more. After a stall of a machine or of a path, all responses come at once. The first few are passed
    on immediately, the others at a rate that a busy node can take.

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
