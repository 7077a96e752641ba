"""Wait-set thread: one wait set over all sources, one wake-up of the caller for a batch of events.

I/O; a thread. rclpy releases the interpreter's lock while it waits. The caller adds and removes sources; a removed
source stays valid until the thread has released it. If the caller does not keep up, subscriptions are not read, and
their queues drop messages by their QoS.
"""

from __future__ import annotations

import logging
import os
import time
from contextlib import ExitStack
from threading import Lock, Thread
from typing import Final

from gdp.intervals import WATCH_S
from proxy.endpoints.core.endpoint import EndpointError, Event, Graph, GraphChanged, MessageReceived, Role, TypeResolved
from proxy.endpoints.ros2.entities import ClientEntity, Kind, PublisherEntity, ServiceEntity, Source, SubscriptionEntity
from proxy.endpoints.ros2.graph_cache import GraphCache
from proxy.endpoints.ros2.qos import incompatibility
from proxy.endpoints.ros2.session import ContextNode

log = logging.getLogger(__name__)

_BACKLOG_MAX_BYTES: Final = 64 << 20
_HOLD_S: Final = 0.005  # rcl has no event for "this client has its server"


class WaitThread:
    """Reads sources and queues their events."""

    def __init__(self, session: ContextNode) -> None:
        self._session = session
        self._survey = GraphCache(session)
        self._survey.refresh()
        self._guard = session.guard()
        self._lock = Lock()
        self._sources: dict[int, Source] = {}
        self._publishers: dict[int, PublisherEntity] = {}
        self._unjudged: set[int] = set()
        self._faults: dict[int, str] = {}
        self._events: list[Event] = []
        self._backlog_bytes = 0
        self._has_changed = True
        self._is_over = False
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._thread = Thread(target=self._run, name="ros2 wait", daemon=True)
        self._thread.start()

    @property
    def graph(self) -> Graph:
        """Return the last known graph."""
        return self._survey.graph

    def fileno(self) -> int:
        """Return a descriptor that is readable while there are events."""
        return self._fd

    def add(self, end: Source | PublisherEntity) -> None:
        """Wait on a source, or check whether a publisher's QoS matches its subscribers."""
        with self._lock:
            if isinstance(end, PublisherEntity):
                self._publishers[end.number] = end
            else:
                self._sources[end.number] = end
                self._has_changed = True
            self._unjudged.add(end.number)
        self._guard.trigger_guard_condition()

    def remove(self, number: int) -> None:
        """Remove an entity; no event names it any more."""
        with self._lock:
            self._publishers.pop(number, None)
            if self._sources.pop(number, None) is not None:
                self._has_changed = True
            self._unjudged.discard(number)
            self._faults.pop(number, None)
            kept: list[Event] = [e for e in self._events if isinstance(e, GraphChanged) or e[0] != number]
            if self._events and not kept:
                os.eventfd_read(self._fd)
            self._events = kept
        self._guard.trigger_guard_condition()

    def add_event(self, event: Event) -> None:
        """Add an event of the caller."""
        self._post([event])

    def wake(self) -> None:
        """Make the thread check its sources."""
        self._guard.trigger_guard_condition()

    def poll_events(self) -> list[Event]:
        """Remove and return the pending events."""
        with self._lock:
            events, self._events = self._events, []
            was_full = self._backlog_bytes >= _BACKLOG_MAX_BYTES
            self._backlog_bytes = 0
            if events:
                os.eventfd_read(self._fd)
        if was_full:
            self._guard.trigger_guard_condition()
        return events

    def close(self) -> None:
        """End the thread; the session may be closed afterwards."""
        self._is_over = True
        self._guard.trigger_guard_condition()
        self._thread.join()
        self._guard.destroy_when_not_in_use()
        os.close(self._fd)

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._is_over:
            with ExitStack() as held:
                with self._lock:
                    sources = list(self._sources.values())
                    for source in sources:
                        held.enter_context(source.handle)
                    self._has_changed = False
                try:
                    due_s = self._wait_on(sources, due_s)
                except RuntimeError as error:
                    log.error("the wait on ROS 2 broke, nothing is heard any more error=%s", error)
                    self._post(
                        [EndpointError(source.number, f"ROS 2 does not wait any more: {error}") for source in sources]
                    )
                    return

    def _wait_on(self, sources: list[Source], due_s: float) -> float:
        """Wait and read until the sources change; return the time of the next refresh of the graph.

        If messages are rare, it wakes once a message, so that work can be done in advance.
        """
        tables: dict[Kind, dict[int, Source]] = {"subscription": {}, "service": {}, "client": {}}
        for source in sources:
            tables[source.kind][source.handle.pointer] = source
        wait_set = self._session.wait_set(*(len(table) for table in tables.values()))
        joins = [source.join(wait_set) for source in sources]
        joins_when_full = [source.join(wait_set) for source in sources if source.kind != "subscription"]
        used = [(kind, table) for kind, table in tables.items() if table]
        client_entity = [source for source in sources if isinstance(source, ClientEntity)]
        servers = [source for source in sources if isinstance(source, ServiceEntity)]
        while not self._has_changed and not self._is_over:
            wait_set.clear_entities()
            wait_set.add_guard_condition(self._guard)
            for join in joins if self._backlog_bytes < _BACKLOG_MAX_BYTES else joins_when_full:
                join()
            is_holding = any(source.is_holding for source in client_entity)
            rest_s = due_s - time.monotonic()
            wait_set.wait(max(0, int(1e9 * (min(rest_s, _HOLD_S) if is_holding else rest_s))))
            for kind, table in used:
                for pointer in wait_set.get_ready_entities(kind):
                    self._post(self._drained(table[pointer]))
            now_s = time.monotonic()
            if is_holding or now_s >= due_s:
                self._post([event for source in client_entity for event in source.tend(now_s)])
            if now_s >= due_s:
                for source in servers:
                    source.tend(now_s)
                self._refresh_graph()
                due_s = time.monotonic() + WATCH_S
        wait_set.destroy_when_not_in_use()
        return due_s

    def _drained(self, source: Source) -> list[Event]:
        try:
            events = source.poll_events()
        except (RuntimeError, ValueError) as error:  # rclpy's own errors, and text that is not UTF-8
            return [EndpointError(source.number, f"cannot be taken: {error}")]
        if isinstance(source, SubscriptionEntity) and source.described is None and events:
            source.described = source.describe(self._survey.query_topic(source.topic))
            events.insert(0, TypeResolved(source.number, source.described))
        return events

    def _refresh_graph(self) -> None:
        try:
            has_changed = self._survey.refresh()
        except RuntimeError as error:
            log.warning("the graph cannot be looked at error=%s", error)
            return
        with self._lock:
            judged: list[SubscriptionEntity | PublisherEntity] = [
                end
                for end in (*self._sources.values(), *self._publishers.values())
                if isinstance(end, (SubscriptionEntity, PublisherEntity))
                and (has_changed or end.number in self._unjudged)
            ]
            self._unjudged.clear()
        events: list[Event] = [GraphChanged()] if has_changed else []
        for end in judged:
            events += self._check_qos(end)
        self._post(events)

    def _check_qos(self, end: SubscriptionEntity | PublisherEntity) -> list[Event]:
        events: list[Event] = []
        ends = self._survey.ends_of(end.topic)
        if (
            isinstance(end, SubscriptionEntity)
            and end.described is not None
            and any(e.role is Role.PUBLISHES for e in ends)
        ):
            channel = end.describe(ends)
            if channel != end.described:
                end.described = channel
                events.append(TypeResolved(end.number, channel))
        role = Role.SUBSCRIBES if isinstance(end, SubscriptionEntity) else Role.PUBLISHES
        fault = incompatibility(role, end.channel, end.qos, ends)
        if fault and fault != self._faults.get(end.number):
            events.append(EndpointError(end.number, fault))
        with self._lock:
            if end.number in self._sources or end.number in self._publishers:
                self._faults[end.number] = fault
        return events

    def _post(self, events: list[Event]) -> None:
        if not events:
            return
        with self._lock:
            live = [
                event
                for event in events
                if isinstance(event, GraphChanged) or event[0] in self._sources or event[0] in self._publishers
            ]
            if not live:
                return
            if not self._events:
                os.eventfd_write(self._fd, 1)
            self._events += live
            self._backlog_bytes += sum(len(event.raw) for event in live if isinstance(event, MessageReceived))
