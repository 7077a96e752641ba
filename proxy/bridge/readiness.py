"""Readiness probe of one local server: requests of remote clients come only while it passes.

I/O: it calls a local service, or subscribes to a local topic. ``Thresholds`` is sans-I/O.
Source: Kubernetes, "Configure Liveness, Readiness and Startup Probes".
"""

from __future__ import annotations

from typing import Final

from proxy.bridge.cancellation import NO_FIELDS, TRIGGER
from proxy.bridge.endpoint_dispatch import EndpointDispatcher
from proxy.config.readiness import Readiness
from proxy.endpoints.core.endpoint import CallFailed, EndpointError, Event, MessageReceived, ResponseReceived
from proxy.serial.channel import RosVersion

_SUCCESS_AT: Final[dict[RosVersion, int]] = {1: 0, 2: 4}  # ``bool success`` is the first field of the response


class Thresholds:
    """Readiness from successes and failures in a row; a new server is not ready."""

    def __init__(self, *, failures: int, successes: int) -> None:
        self.is_ready = False
        self._needed = {True: successes, False: failures}
        self._row = 0  # results that speak against the present state

    def add(self, *, is_success: bool) -> bool:
        """Take a result; return whether the readiness changed."""
        if is_success == self.is_ready:
            self._row = 0
            return False
        self._row += 1
        if self._row < self._needed[is_success]:
            return False
        self.is_ready, self._row = is_success, 0
        return True


class ReadinessProbe:
    """Probe of one local server, as its rule states it.

    Raises:
        LocalError: a type of the probe is not known on this machine.
    """

    def __init__(self, dispatcher: EndpointDispatcher, settings: Readiness, now_s: float) -> None:
        self._dispatcher = dispatcher
        self.settings = settings
        self._thresholds = Thresholds(failures=settings.failure_threshold, successes=settings.success_threshold)
        self._asked_s = now_s
        self._call = 0
        self._is_asked = False  # a call is under way
        self._has_ticked = False
        self._is_changed = False
        self._due_s = now_s + settings.initial_delay_s
        self.reason = "not probed yet"
        if settings.service is not None:
            self._handle = dispatcher.create_client(self, settings.service, TRIGGER)
        else:
            self._handle = dispatcher.subscribe(self, settings.topic or "", settings.type_name, None)
            self._due_s += settings.period_s

    @property
    def is_ready(self) -> bool:
        """Return whether requests may come."""
        return self._thresholds.is_ready

    def poll_changed(self) -> bool:
        """Return whether the readiness changed since the last poll."""
        is_changed, self._is_changed = self._is_changed, False
        return is_changed

    def get_timer(self) -> float:
        """Return the monotonic second of the next probe, or of the end of the present one."""
        return self._due_s

    def handle_timer(self, now_s: float) -> None:
        """Begin a probe, or count that one got no answer."""
        if now_s < self._due_s:
            return
        settings = self.settings
        if settings.service is None:
            self._take(is_success=self._has_ticked, reason=f"{settings.topic} is silent")
            self._has_ticked = False
            self._due_s = now_s + settings.period_s
        elif self._is_asked:
            self._dispatcher.endpoint.drop(self._handle, self._call)
            self._is_asked = False
            self._take(is_success=False, reason=f"{settings.service}: no answer within {settings.timeout_s:g} s")
            self._due_s = now_s + max(settings.period_s - settings.timeout_s, 0.0)
        else:
            self._call += 1
            self._is_asked = True
            self._due_s = now_s + settings.timeout_s
            self._asked_s = now_s
            self._dispatcher.endpoint.call(self._handle, self._call, NO_FIELDS[self._dispatcher.endpoint.ros])

    def handle_event(self, event: Event, now_s: float) -> None:
        """Take the answer of the service, or a message of the topic."""
        name = self.settings.service or self.settings.topic
        if isinstance(event, MessageReceived):
            self._has_ticked = True
            if not self.is_ready and self.settings.success_threshold == 1:
                self._take(is_success=True, reason="")  # it need not wait for the end of the period
        elif isinstance(event, ResponseReceived | CallFailed) and event.call == self._call and self._is_asked:
            self._is_asked = False
            self._due_s = max(self._asked_s + self.settings.period_s, now_s)
            if isinstance(event, CallFailed):
                self._take(is_success=False, reason=f"{name}: {event.reason}")
            else:
                at = _SUCCESS_AT[self._dispatcher.endpoint.ros]
                is_success = len(event.raw) > at and event.raw[at] == 1
                self._take(is_success=is_success, reason=f"{name} answers success: false")
        elif isinstance(event, EndpointError):
            self._take(is_success=False, reason=f"{name}: {event.reason}")

    def close(self) -> None:
        """End the probe."""
        self._dispatcher.close(self._handle)

    def _take(self, *, is_success: bool, reason: str) -> None:
        self.reason = "" if is_success else reason
        self._is_changed |= self._thresholds.add(is_success=is_success)
