"""Bridge node: the loop that drives the overlay's participant, the endpoints and the bridge between them."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

from gdp.cli.node import emit, emit_wait, report
from gdp.errors import LocalError
from gdp.extras import Seam
from gdp.intervals import TICK_S, TURN_S
from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore
from gdp.terminal import echo
from proxy.bridge.bridge import Bridge, FlowChange
from proxy.bridge.call_tracer import CallTracer
from proxy.bridge.core.desired_flows import FlowSpec
from proxy.bridge.core.topic_stats import percentile
from proxy.config.config import ProxyConfig, Traces
from proxy.endpoints.core.endpoint import proxy_node_name
from proxy.endpoints.live import open_endpoints
from proxy.node.control_answer import answer_control
from proxy.node.node import ProxyNode, run_node
from proxy.node.proxy_state import described
from proxy.node.state_answer import answer_for_proxy

log = logging.getLogger(__name__)

_LOOK_S: Final = 2.0  # with less, a new proxy may not detect yet that another proxy of its graph carries the same
DRAIN_MAX_S: Final = 10.0  # after this time a leaving server abandons unanswered requests
_TRACERS: Final[Seam[Callable[[Traces, Name, str], CallTracer]]] = Seam("gdp.tracer")


def run(path: Path, settings: ProxyConfig, *, json: bool) -> None:
    """Carry the configured names between the graphs and the overlay until stopped.

    Args:
        path: of the configuration, to read it again after a SIGHUP.

    Raises:
        LocalError: keys, delegations or the device are not as configured, or an endpoint is unavailable.
    """
    sys.setswitchinterval(TURN_S)
    with run_node(settings, emit_wait if json else None) as node:
        state, name = node.state, proxy_node_name(node.identity.name.to_text())
        with open_endpoints(settings.ros, name) as endpoints:
            held = DelegationStore(settings.delegations, node.identity)
            tracer = open_tracer(settings.traces, node.identity.name, node.identity.label)
            look_s = 0.0 if all(end.exclusive for end in settings.ros) else _LOOK_S
            state.context = replace(state.context, tracer=tracer, keeper=node.open_keeper(settings, held))
            state.bridge = bridge = Bridge(
                state.context, settings, endpoints, held, look_s=look_s, status_topic=settings.status
            )
            state.ros_domains = tuple(end.domain_id for end in settings.ros if end.endpoint != "ros1")
            state.has_topic_names = settings.metrics is not None and settings.metrics.topic_names
            answer_for_proxy(state, bridge)
            answer_control(state, bridge)
            node.drains = True
            node.on_reload = lambda: _reload(path, settings, node, bridge)
            for endpoint in endpoints:
                node.runtime.watch(endpoint)
            try:
                _work(node, bridge, json=json)
            finally:
                for endpoint in endpoints:
                    node.runtime.unwatch(endpoint)
                tracer.close()
                if state.context.keeper is not None:
                    state.context.keeper.capsules.close(time.time())
            best_effort = bridge.best_effort
            node.say_goodbye(bridge)
        if json:
            sent = [stats.to_fields() for stats in best_effort]
            topics = [stats.to_fields() for stats in bridge.stats]
            emit("done", topics=topics, best_effort_topics=sent, faults=dict(state.context.faults.counts))
        else:
            for stats in bridge.stats:
                median_ms = percentile(sorted(stats.latencies_ms), 0.5)
                if median_ms is not None or stats.lost:
                    median = "-" if median_ms is None else f"{median_ms:.1f} ms"
                    lost = f", {stats.losses.words()}" if stats.losses.total else ""
                    echo(f"  {stats.topic}: {stats.received} received, median {median}{lost}")
            for sent_stats in best_effort:
                if not sent_stats.is_whole:
                    echo(f"  {sent_stats.words()}")
            traffic, faults = state.context.traffic, state.context.faults
            echo(f"{traffic.messages_out} messages sent, {traffic.messages_in} received, {faults.total} faults")


def open_tracer(traces: Traces | None, node: Name, label: str) -> CallTracer:
    """Return the tracer that a configuration asks for.

    Raises:
        MissingExtraError: it asks for one, and the extra ``otel`` is not installed.
    """
    if traces is None:
        return CallTracer()
    return _TRACERS.get("otel", "traces")(traces, node, label)


def _work(node: ProxyNode, bridge: Bridge, *, json: bool) -> None:
    """Run until stopped, and report progress."""
    is_ready = False
    leave_at_s: float | None = None
    node.runtime.every(TICK_S, lambda _: _tell_progress(node, bridge), lambda: json and is_ready)
    while not node.runtime.is_stopped:
        now_s = node.step(bridge, None if leave_at_s is None else time.monotonic() + TICK_S)
        if node.is_leaving:
            if leave_at_s is None:
                log.info("leaving; what is under way is answered")
                leave_at_s = now_s + DRAIN_MAX_S
            bridge.drain(now_s)  # repeatedly: a local server may appear meanwhile
            node.has_drained = bridge.is_drained(now_s)
            if now_s >= leave_at_s and not node.has_drained:
                log.warning("leaving after %g s before all calls are answered and confirmed", DRAIN_MAX_S)
            if now_s >= leave_at_s or node.has_drained:
                return
        if not is_ready and node.member.attachment.is_attached and bridge.is_settled:
            is_ready = True
            node.tell_refusals()
            _tell_ready(node, bridge, json=json)
        if is_ready:
            for change in bridge.poll_changes():
                _tell_change(change, json=json)


def _tell_change(change: FlowChange, *, json: bool) -> None:
    """Say that a flow began or ended after the start: a node came or went, or the rules were read again."""
    text = f"  {'+' if change.is_begun else '-'} {_line(change.flow_spec)}"
    report("flow", text, json=json, change="begun" if change.is_begun else "ended", **described(change.flow_spec))


def _line(flow_spec: FlowSpec) -> str:
    kind = "" if flow_spec.rule.kind == "topic" else f"{flow_spec.rule.kind} "
    return f"{'expose' if flow_spec.is_exposed else 'import'} {kind}{flow_spec.local} [{flow_spec.type_name}]"


def _tell_ready(node: ProxyNode, bridge: Bridge, *, json: bool) -> None:
    bridge.poll_changes()  # those before are in the list
    if json:
        emit("ready", name=node.member.name.to_text())
        return
    echo(f"proxy {node.member.name.short} is attached, in {', '.join(bridge.labels)}; Ctrl-C ends it")
    for flow_spec, _ in bridge.flows:
        echo(f"  {_line(flow_spec)}")


def _tell_progress(node: ProxyNode, bridge: Bridge) -> None:
    stats, context = bridge.stats, node.state.context
    emit(
        "progress",
        sent=context.traffic.messages_out,
        received=context.traffic.messages_in,
        flows=len(bridge.flows),
        faults=context.faults.total,
        lost=sum(each.lost for each in stats),
        topics=[
            {
                "topic": each.topic,
                "received": each.received,
                "lost": each.lost,
                "latency_ms": each.latencies_ms[-1] if each.latencies_ms else None,
            }
            for each in stats
            if each.latencies_ms or each.lost
        ],
        best_effort_topics=[each.to_fields() for each in bridge.best_effort if not each.is_whole],
    )


def _reload(path: Path, first: ProxyConfig, node: ProxyNode, bridge: Bridge) -> None:
    """Read the configuration and the delegations again; flows with an unchanged rule continue."""
    settings = ProxyConfig.load(path)
    held = DelegationStore(settings.delegations, node.identity)
    for key in ("identity", "domain", "iface", "ros", "metrics", "sandbox", "state", "status", "control_socket"):
        if getattr(settings, key) != getattr(first, key):
            raise LocalError(f"{path}: {key} changed; restart the proxy to change it")
    bridge.reload(settings, held)
    log.info("configuration reloaded rules=%d", len(settings.expose) + len(settings.imports))
