"""OpenTelemetry spans of service calls, exported by OTLP over HTTP.

I/O: a thread of the SDK sends batches; a full queue loses spans, never calls. The spans of one call::

    call /plan            client's proxy, CLIENT: from the request until its first response; event ``first answer``
      replica 75e…0fc     client's proxy, one for each server that was asked, until its own response, even a late one
      serve /plan         server's proxy, SERVER: from the request's arrival until the response left

Source of the attributes: OpenTelemetry semantic conventions, RPC (``rpc.system``, ``rpc.service``).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import SpanProcessor, TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor
from opentelemetry.sdk.trace.id_generator import RandomIdGenerator
from opentelemetry.trace import NonRecordingSpan, Span, SpanContext, SpanKind, TraceFlags, set_span_in_context
from opentelemetry.trace.status import Status, StatusCode

from gdp.names import Name
from gdp.state.snapshot import short_id
from proxy.bridge.call_tracer import CallKey, CallTracer, trace_ids
from proxy.config.config import Traces

log = logging.getLogger(__name__)

CALLS_MAX: Final = 4_096  # traced at once; further calls have no spans and are counted
LATE_S: Final = 10.0  # spans of replicas that are silent so long after the first response end without one
_RATIO_BITS: Final = 64


@dataclass(slots=True)
class _Call:
    root: Span
    replicas: dict[Name, Span] = field(default_factory=dict)
    is_ended: bool = False


class _Ids(RandomIdGenerator):
    """Random ids, except for those that are set for the next span."""

    given: tuple[int, int] | None = None

    def generate_trace_id(self) -> int:
        """Return the trace id of the next span."""
        return super().generate_trace_id() if self.given is None else self.given[0]

    def generate_span_id(self) -> int:
        """Return the id of the next span."""
        return super().generate_span_id() if self.given is None else self.given[1]


class OtelTracer(CallTracer):
    """Spans of one proxy.

    Args:
        processor: takes finished spans; it is shut down with the tracer.
        ratio: share of the calls that are traced, the same calls at client and server.

    Attributes:
        untraced: calls beyond ``CALLS_MAX``.
    """

    def __init__(self, processor: SpanProcessor, *, node: Name, label: str, ratio: float = 1.0) -> None:
        self._ids = _Ids()
        resource = Resource.create({"service.name": "gdp-proxy", "service.instance.id": f"{label} {short_id(node)}"})
        self._provider: TracerProvider = TracerProvider(
            resource=resource, id_generator=self._ids, shutdown_on_exit=False
        )
        self._provider.add_span_processor(processor)
        self._tracer = self._provider.get_tracer("gdp")
        self._limit = int(ratio * (1 << _RATIO_BITS))
        self._calls: dict[CallKey, _Call] = {}
        self._ended_s: dict[CallKey, float] = {}  # calls whose servers did not all respond, in the order of their end
        self._served: dict[CallKey, Span] = {}
        self.untraced = 0

    def begun(self, key: CallKey, local: str) -> None:
        """Begin the root span."""
        self._end_late()
        if not self._is_traced(key, len(self._calls)):
            return
        ids = trace_ids(key)
        self._ids.given = ids.trace, ids.span
        try:
            root = self._tracer.start_span(f"call {local}", kind=SpanKind.CLIENT, attributes=_attributes(key, local))
        finally:
            self._ids.given = None
        self._calls[key] = _Call(root)

    def asked(self, key: CallKey, servers: Iterable[Name]) -> None:
        """Begin a span for each server."""
        call = self._calls.get(key)
        if call is None:
            return
        context = set_span_in_context(call.root)
        for server in servers:
            if server not in call.replicas:
                attributes = {"gdp.server": short_id(server)}
                call.replicas[server] = self._tracer.start_span(
                    f"replica {server.short}", context, attributes=attributes
                )

    def responded(self, key: CallKey, server: Name, error: str = "") -> None:
        """End the span of a server."""
        call = self._calls.get(key)
        span = None if call is None else call.replicas.pop(server, None)
        if call is None or span is None:
            return
        span.set_attribute("gdp.first", not error and not call.is_ended)
        if error:
            span.set_status(Status(StatusCode.ERROR, error))
        span.end()
        if call.is_ended and not call.replicas:
            del self._calls[key], self._ended_s[key]

    def answered(self, key: CallKey, server: Name) -> None:
        """End the root span with the first response."""
        call = self._calls.get(key)
        if call is None:
            return
        call.root.add_event("first answer", {"gdp.server": short_id(server)})
        call.root.set_attribute("gdp.server", short_id(server))
        self._end_root(key, call)

    def failed(self, key: CallKey, reason: str) -> None:
        """End the root span as an error."""
        call = self._calls.get(key)
        if call is None:
            return
        call.root.set_status(Status(StatusCode.ERROR, reason))
        self._end_root(key, call)

    def serving(self, key: CallKey, local: str) -> None:
        """Begin the span of the server's side, below the client's root span."""
        if key in self._served or not self._is_traced(key, len(self._served)):
            return
        ids = trace_ids(key)
        parent = SpanContext(ids.trace, ids.span, is_remote=True, trace_flags=TraceFlags(TraceFlags.SAMPLED))
        self._served[key] = self._tracer.start_span(
            f"serve {local}",
            set_span_in_context(NonRecordingSpan(parent)),
            kind=SpanKind.SERVER,
            attributes=_attributes(key, local),
        )

    def served(self, key: CallKey, error: str = "") -> None:
        """End the span of the server's side."""
        span = self._served.pop(key, None)
        if span is None:
            return
        if error:
            span.set_status(Status(StatusCode.ERROR, error))
        span.end()

    def close(self) -> None:
        """End all spans, send what is finished, and end the thread."""
        for call in self._calls.values():
            for span in (*call.replicas.values(), *(() if call.is_ended else (call.root,))):
                span.end()
        for span in self._served.values():
            span.end()
        self._calls.clear()
        self._served.clear()
        if self.untraced:
            log.warning("calls without spans count=%d limit=%d", self.untraced, CALLS_MAX)
        self._provider.shutdown()

    def _is_traced(self, key: CallKey, under_way: int) -> bool:
        if trace_ids(key).trace & ((1 << _RATIO_BITS) - 1) >= self._limit:
            return False
        if under_way >= CALLS_MAX:
            self.untraced += 1
            return False
        return True

    def _end_root(self, key: CallKey, call: _Call) -> None:
        call.root.end()
        if call.replicas:
            call.is_ended = True
            self._ended_s[key] = time.monotonic()
        else:
            del self._calls[key]

    def _end_late(self) -> None:
        """End the spans of servers that stay silent."""
        now_s = time.monotonic()
        while self._ended_s:
            key, ended_s = next(iter(self._ended_s.items()))
            if now_s - ended_s < LATE_S:
                return
            del self._ended_s[key]
            for span in self._calls.pop(key).replicas.values():
                span.set_attribute("gdp.first", False)
                span.add_event("no answer")
                span.end()


def open_tracer(traces: Traces, node: Name, label: str) -> CallTracer:
    """Return the tracer that a configuration asks for."""
    processor = BatchSpanProcessor(OTLPSpanExporter(endpoint=traces.endpoint, timeout=traces.timeout_s))
    return OtelTracer(processor, node=node, label=label, ratio=traces.ratio)


def _attributes(key: CallKey, local: str) -> dict[str, str | int]:
    return {
        "rpc.system": "ros",
        "rpc.service": local,
        "gdp.name": short_id(key.service),
        "gdp.client": short_id(key.client),
        "gdp.part": key.part,
    }
