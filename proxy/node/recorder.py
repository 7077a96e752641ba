"""Recorder: a proxy without a live graph, whose bridge records or only counts what it imports."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

from gdp.cli.node import emit, emit_wait, report
from gdp.errors import LocalError
from gdp.intervals import TICK_S
from gdp.terminal import echo
from proxy.bridge.bridge import Bridge
from proxy.bridge.core.topic_stats import TopicStats
from proxy.config.config import ProxyConfig, Record
from proxy.config.recorded import RecordedRules
from proxy.node.node import ProxyNode, run_node
from proxy.node.recording_bridge import open_recording_bridge
from proxy.recordings.endpoint import RecordingEndpoint
from proxy.recordings.split import SplitWriter, first_part
from proxy.serial.channel import RosVersion


def record(settings: ProxyConfig, *, json: bool) -> bool:
    """Receive the configured imports until stopped, or until they cannot be written; return whether all are.

    Raises:
        LocalError: keys, delegations, the device or the file are not as configured.
    """
    refuse_existing_file(settings)
    rules = RecordedRules.of(imports=settings.imports)
    with run_node(settings, emit_wait if json else None) as node, contextlib.ExitStack() as stack:
        writer = _writer(settings.record)
        if writer is not None:
            stack.callback(writer.close)  # what was written stays whatever happens
        endpoint = RecordingEndpoint(writer, [(rule.local, rule.type_name) for rule in rules.imports])
        with open_recording_bridge(node, settings, rules, endpoint) as bridge:
            _work(node, bridge, writer, json=json)
            stats = bridge.stats
            node.say_goodbye(bridge)
        unfinished = _finish(writer)
    _report(stats, writer, json=json)
    if unfinished:
        echo(f"error: the recording ended early: {unfinished}", err=True)
    return not unfinished


def _finish(writer: SplitWriter | None) -> str:
    """Complete the recording; return what it lacks, empty where it lacks nothing."""
    if writer is None:
        return ""
    try:
        writer.close()
    except LocalError as error:
        return str(error)
    if writer.written == writer.received:
        return ""
    held = f"{writer.written} of {writer.received} messages are in {', '.join(map(str, writer.paths))}"
    return f"{writer.failure or 'a stamp or a channel was refused'}; {held}"


def refuse_existing_file(settings: ProxyConfig) -> None:
    """Refuse to record into an existing file. Raises ``LocalError``: the file exists."""
    record = settings.record
    if record is not None and (path := first_part(record.path, is_split=record.is_split)).exists():
        raise LocalError(f"{path} exists already; move or delete it, or change record.path")


def _writer(record: Record | None) -> SplitWriter | None:
    if record is None:
        return None
    ros: RosVersion = 1 if record.format == "ros1" else 2
    return SplitWriter(record.path, ros, max_bytes=record.split_bytes, max_s=record.split_s)


def _work(node: ProxyNode, bridge: Bridge, writer: SplitWriter | None, *, json: bool) -> None:
    """Receive until stopped, or until nothing can be written any more; report progress."""
    is_ready = False
    node.runtime.every(TICK_S, lambda _: _report_progress(bridge.stats), lambda: json and is_ready)
    if writer is not None:
        node.runtime.every(TICK_S, lambda _: writer.flush())
    while not node.runtime.is_stopped:
        node.step(bridge)
        if writer is not None and writer.failure:
            return
        if not is_ready and node.member.attachment.is_attached:
            is_ready = True
            node.tell_refusals()
            name = node.member.name
            report("ready", f"proxy {name.short} is attached; Ctrl-C ends it", json=json, name=name.to_text())


def _report_progress(stats: Sequence[TopicStats]) -> None:
    latest = [each.latencies_ms[-1] for each in stats if each.latencies_ms]
    emit(
        "progress",
        received=sum(each.received for each in stats),
        lost=sum(each.lost for each in stats),
        latency_ms=round(sum(latest) / len(latest), 3) if latest else None,
    )


def _report(topics: Sequence[TopicStats], writer: SplitWriter | None, *, json: bool) -> None:
    if json:
        about = {} if writer is None else {"written": writer.written, "files": [str(path) for path in writer.paths]}
        emit("done", topics=[stats.to_fields() for stats in topics], **about)
        return
    received, lost = sum(stats.received for stats in topics), sum(stats.lost for stats in topics)
    echo(f"{received} messages received, {lost} lost")
    for stats in topics:
        if stats.lost:
            refused = f", {stats.refused} not handed over" if stats.refused else ""
            echo(f"  {stats.topic}: {stats.received} received, {stats.losses.words()}{refused}")
