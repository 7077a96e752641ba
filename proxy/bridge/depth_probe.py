"""Depth probe: finds out how many messages a latched local publisher keeps, which the discovery of DDS does not tell.

I/O through the endpoint. A second subscription joins late and counts what comes. If that is less than was published,
it is the depth. Only a time without messages gives a count that is exact.
"""

from __future__ import annotations

from gdp.errors import LocalError
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.endpoints.core.endpoint import Event, MessageReceived
from proxy.endpoints.core.qos import DEPTH_MAX
from proxy.serial.channel import Qos

_QUIET_S = 1.0  # without a message, before a probe and during it
_TRIES = 8  # one for each further message; later ones when the messages have doubled


class DepthProbe:
    """Probe of one topic, which one publisher publishes.

    Args:
        profile: under which the proxy's own subscription reads it.

    Attributes:
        depth: messages that it keeps; None: not known yet.
    """

    def __init__(self, dispatcher: EndpointDispatcher, local: str, type_name: str, profile: Qos | None) -> None:
        self._dispatcher = dispatcher
        self._reads = local, type_name, profile
        self.depth: int | None = None
        self._handle: int | None = None
        self._published = 0
        self._counted = 0
        self._ask_from = 2  # messages
        self._tries = 0
        self._due_s: float | None = None

    def handle_message(self, now_s: float) -> None:
        """Process a message of the publisher."""
        self._published += 1
        if self.depth is None and self._published >= self._ask_from:
            self.close()
            self._due_s = now_s + _QUIET_S

    def handle_event(self, event: Event, now_s: float) -> None:
        """Process an event of the second subscription."""
        del now_s
        self._counted += isinstance(event, MessageReceived)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        return self._due_s

    def handle_timer(self, now_s: float) -> bool:
        """Begin or end a probe that is due; return whether the depth is known now."""
        if self._due_s is None or now_s < self._due_s:
            return False
        if self._handle is None:
            self._counted, self._due_s = 0, now_s + _QUIET_S
            try:
                self._handle = self._dispatcher.subscribe(self, *self._reads)
            except LocalError:
                self._due_s = None  # the topic has gone; the next message asks again
            return False
        self.close()
        self._tries += 1
        kept, published = self._counted, self._published
        if 0 < kept < published or kept >= DEPTH_MAX:
            self.depth = min(kept, DEPTH_MAX)
            return True
        self._ask_from = published + 1 if self._tries < _TRIES else 2 * published
        return False

    def close(self) -> None:
        """End the probe that is under way."""
        self._due_s = None
        if self._handle is not None:
            self._dispatcher.close(self._handle)
            self._handle = None
