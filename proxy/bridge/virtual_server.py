"""Virtual server: what local clients see in place of the remote servers of one service or action.

I/O through the endpoint. The virtual server exists while a remote server is reachable. When the last one goes, it stays
for a moment: a middleware drops a response that its client has not received when the server ends. Fast DDS and Cyclone
DDS do so, and a busy client's process may not run for a while. Requests that come in this time are refused.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from gdp.due_queue import earliest
from proxy.bridge.core.action_interface import PROFILES
from proxy.bridge.local_responses import LocalResponses
from proxy.bridge.service_flow import ServiceFlow
from proxy.wire.service import Exchange

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
