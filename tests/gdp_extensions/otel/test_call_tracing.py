"""Traces of service calls: one trace from the client's proxy to each replica, and nothing of it on the wire."""

from __future__ import annotations

import http.server
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("opentelemetry.sdk")

from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import SpanKind, StatusCode
from pydantic import ValidationError

from gdp.names import Name
from gdp.service.frames import Request
from gdp_extensions.otel.tracer import CALLS_MAX, OtelTracer, open_tracer
from proxy.bridge.call_tracer import CallKey, CallTracer, trace_ids
from proxy.config.config import Traces
from proxy.node import bridge_node
from tests.proxy.bridge.known import switch, switched
from tests.proxy.bridge.sites import Machine, Sites
from tests.proxy.bridge.test_replicas import replicas

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import ReadableSpan

KEY = CallKey(Name(b"s" * 32), Name(b"c" * 32), 0, 7)
ONE, TWO = Name(b"1" * 32), Name(b"2" * 32)


@pytest.fixture
def exporter() -> InMemorySpanExporter:
    return InMemorySpanExporter()


@pytest.fixture
def tracer(exporter: InMemorySpanExporter) -> Iterator[OtelTracer]:
    made = OtelTracer(SimpleSpanProcessor(exporter), node=KEY.client, label="robot")
    yield made
    made.close()


def named(exporter: InMemorySpanExporter) -> dict[str, ReadableSpan]:
    """Return the finished spans by name."""
    return {each.name: each for each in exporter.get_finished_spans()}


def test_a_call_has_a_span_for_each_replica_and_the_first_answer(
    tracer: OtelTracer, exporter: InMemorySpanExporter
) -> None:
    tracer.begun(KEY, "/plan")
    tracer.asked(KEY, [ONE, TWO])
    tracer.responded(KEY, TWO)
    tracer.answered(KEY, TWO)
    tracer.responded(KEY, ONE)
    spans = named(exporter)
    root = spans["call /plan"]
    assert root.kind is SpanKind.CLIENT
    assert [each.name for each in root.events] == ["first answer"]
    ids = trace_ids(KEY)
    assert root.context is not None
    assert root.context.trace_id == ids.trace
    assert root.context.span_id == ids.span
    for server, is_first in ((ONE, False), (TWO, True)):
        span = spans[f"replica {server.short}"]
        assert span.parent is not None
        assert span.context is not None
        assert (span.parent.span_id, span.context.trace_id) == (ids.span, ids.trace)
        assert span.attributes is not None
        assert span.attributes["gdp.first"] is is_first


def test_a_server_that_stays_silent_has_a_span_without_an_answer(exporter: InMemorySpanExporter) -> None:
    tracer = OtelTracer(SimpleSpanProcessor(exporter), node=KEY.client, label="robot")
    tracer.begun(KEY, "/plan")
    tracer.asked(KEY, [ONE])
    tracer.failed(KEY, "no answer within 1 s")
    tracer.close()
    root = named(exporter)["call /plan"]
    assert (root.status.status_code, root.status.description) == (StatusCode.ERROR, "no answer within 1 s")
    assert f"replica {ONE.short}" in named(exporter)


def test_both_sides_choose_the_same_calls_and_more_than_the_limit_are_counted(exporter: InMemorySpanExporter) -> None:
    tracer = OtelTracer(SimpleSpanProcessor(exporter), node=KEY.client, label="robot", ratio=0.5)
    for call in range(400):
        key = KEY._replace(call=call)
        tracer.begun(key, "/plan")
        tracer.serving(key, "/plan")
    assert tracer._calls.keys() == tracer._served.keys()
    assert 120 < len(tracer._calls) < 280
    tracer.close()
    full = OtelTracer(SimpleSpanProcessor(exporter), node=KEY.client, label="robot")
    for call in range(CALLS_MAX + 3):
        full.begun(KEY._replace(call=call), "/plan")
    assert full.untraced == 3
    full.close()


def test_ids_depend_on_every_part_of_a_call() -> None:
    others = [KEY._replace(call=8), KEY._replace(part=1), KEY._replace(client=ONE), KEY._replace(service=ONE)]
    assert len({trace_ids(KEY), *map(trace_ids, others)}) == 5


def test_one_trace_joins_client_and_replicas_and_nothing_of_it_is_in_the_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[Request] = []
    read = Request.from_wire

    def record(_: type[Request], wire: bytes) -> Request:
        sent.append(read(wire))
        return sent[-1]

    monkeypatch.setattr(Request, "from_wire", classmethod(record))
    sites = Sites(tmp_path)
    servers, locals_, client, caller = replicas(sites, 2)
    exporters = [InMemorySpanExporter() for _ in range(3)]
    for machine, exporter in zip((client, *servers), exporters, strict=True):
        trace(machine, exporter)
    caller.call(switch(on=True))
    assert sites.run(5, lambda: all(each.waiting for each in locals_))
    for local in locals_:
        local.waiting[0][1](switched("on"))
    assert sites.run(5, lambda: len(exporters[0].get_finished_spans()) == 3)
    spans = [span for exporter in exporters for span in exporter.get_finished_spans()]
    root = next(each for each in spans if each.name == "call /switch")
    others = [each for each in spans if each is not root]
    assert sorted(each.name.split(" ")[0] for each in others) == ["replica", "replica", "serve", "serve"]
    assert root.context is not None
    assert {each.parent.span_id for each in others if each.parent is not None} == {root.context.span_id}
    assert {each.context.trace_id for each in spans if each.context is not None} == {root.context.trace_id}
    assert {len(each.to_wire()) - len(each.body) for each in sent} == {14}  # version, part, call and patience
    assert not any(root.context.trace_id.to_bytes(16, "big") in each.to_wire() for each in sent)


def test_spans_reach_a_collector_by_otlp() -> None:
    received: list[ExportTraceServiceRequest] = []

    class Collector(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            received.append(ExportTraceServiceRequest.FromString(body))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *words: object) -> None:
            """Stay silent."""

    with http.server.HTTPServer(("127.0.0.1", 0), Collector) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        tracer = open_tracer(Traces(endpoint=f"http://127.0.0.1:{server.server_port}/v1/traces"), KEY.client, "robot")
        tracer.begun(KEY, "/plan")
        tracer.asked(KEY, [ONE])
        tracer.responded(KEY, ONE)
        tracer.answered(KEY, ONE)
        tracer.close()
        server.shutdown()
        thread.join()
    resources = [each for request in received for each in request.resource_spans]
    spans = [span for each in resources for scope in each.scope_spans for span in scope.spans]
    assert sorted(each.name for each in spans) == ["call /plan", f"replica {ONE.short}"]
    assert {each.trace_id for each in spans} == {trace_ids(KEY).trace.to_bytes(16, "big")}
    values = {each.key: each.value.string_value for each in resources[0].resource.attributes}
    assert (values["service.name"], values["service.instance.id"].split()[0]) == ("gdp-proxy", "robot")


def test_tracing_is_off_unless_it_is_asked_for() -> None:
    assert type(bridge_node.open_tracer(None, KEY.client, "robot")) is CallTracer


def test_an_endpoint_that_is_no_url_is_refused() -> None:
    with pytest.raises(ValidationError, match="endpoint"):
        Traces(endpoint="127.0.0.1:4318")


def trace(machine: Machine, exporter: InMemorySpanExporter) -> None:
    """Trace the calls of a machine that has begun."""
    tracer = OtelTracer(SimpleSpanProcessor(exporter), node=machine.member.name, label=machine.label)
    object.__setattr__(machine.context, "tracer", tracer)
