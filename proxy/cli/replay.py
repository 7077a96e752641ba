"""Command ``gdp-replay``."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from gdp.cli.console import Columns
from gdp.cli.node import Check, Config, Json, Logs, MemberPlane, emit, emit_wait, running, with_plane
from gdp.cli.program import Program
from gdp.errors import LocalError
from gdp.intervals import ATTACH_S, REPORT_S
from gdp.terminal import echo
from proxy.check.command import check_proxy
from proxy.config.config import ProxyConfig
from proxy.config.recorded import RecordedRules
from proxy.node.node import ProxyNode, run_node
from proxy.node.recording_bridge import open_recording_bridge
from proxy.node.replayer import Replay, Unconfirmed
from proxy.recordings.endpoint import ReplayEndpoint
from proxy.recordings.limits import BagLimits
from proxy.recordings.process import RecordingError
from proxy.recordings.reader import BagReader

log = logging.getLogger(__name__)


SkipEmpty = Annotated[
    float | None,
    typer.Option(min=0.0, metavar="SECONDS", help="Skip what a time without messages has more than this."),
]
WaitReaders = Annotated[float, typer.Option(min=0.0, help="Seconds to wait for a reader of every topic.")]

app = Program("gdp-replay")
main = app.run


@app.command(epilog="Example: gdp-replay drive.mcap --config proxy.yaml --rate 2")
def replay(
    bag: Annotated[Path, typer.Argument(help="A ROS 1 bag, an MCAP file, a .db3 file or a rosbag2 folder.")],
    config: Config,
    rate: Annotated[float, typer.Option(min=0.0, help="1: as recorded; 0: as fast as readers confirm.")] = 1.0,
    skip_empty: SkipEmpty = None,
    wait_readers: WaitReaders = 15.0,
    memory: Annotated[
        int | None,
        typer.Option(min=64, metavar="MIB", help="Memory to decode the recording; 1 to 4 GiB, by its length."),
    ] = None,
    cpu: Annotated[
        float | None,
        typer.Option(min=1.0, metavar="SECONDS", help="Processor time to decode it; 30 s and 2 s for each MiB."),
    ] = None,
    data_plane: MemberPlane = None,
    check: Check = False,
    columns: Columns = None,
    json: Json = False,
    *,
    logs: Logs,
) -> None:
    """Replay a recording's exposed topics onto the overlay with the recorded timing.

    Exit 1: a message of a reliable topic was too large, had no reader, or was not confirmed by each reader; this
    includes latched topics. A topic with keep needs no reader once its holders have it. Also if the overlay refused a
    topic, if the recording gives less than it announces, or if it exceeds its memory or time. Best effort is sent
    without confirmation; what was dropped here, and what a reader lost, is stated at the end.
    """
    del columns  # its callback has done all
    limits = BagLimits(None if memory is None else memory << 20, cpu)
    with running(logs), _failing_decoder():
        settings = with_plane(ProxyConfig.load(config), data_plane)
        with BagReader(bag, limits) as reader:
            if check:
                raise typer.Exit(1 if check_proxy(config, settings, json=json) else 0)
            with run_node(settings, emit_wait if json else None) as node:
                is_complete = _replay(node, reader, settings, rate, skip_empty, wait_readers, json=json)
    raise typer.Exit(0 if is_complete else 1)


@contextlib.contextmanager
def _failing_decoder() -> Iterator[None]:
    """Convert the end of the decoding process into one line on standard error and exit code 1."""
    try:
        yield
    except RecordingError as error:
        hint = f" (see --{error.limit})" if error.limit else ""
        echo(f"error: {error}{hint}", err=True)
        raise typer.Exit(1) from error


def _replay(
    node: ProxyNode,
    reader: BagReader,
    settings: ProxyConfig,
    rate: float,
    skip_empty: float | None,
    wait_s: float,
    *,
    json: bool,
) -> bool:
    endpoint = ReplayEndpoint(reader)
    rules = RecordedRules.of(expose=settings.expose)
    with open_recording_bridge(node, settings, rules, endpoint) as bridge:
        said_s = time.monotonic()

        def report() -> None:
            nonlocal said_s
            if json:
                _report_progress(replay, total)
            elif (now_s := time.monotonic()) >= said_s + REPORT_S:
                said_s = now_s
                log.info("progress sent=%d of=%s confirmed=%d", replay.sent, total or "?", replay.confirmed)

        replay = Replay(node, bridge, endpoint, rate, report, skip_empty, node.state.context.keeper)
        total = _exposed_total(reader, endpoint)
        if not replay.topics:
            raise LocalError(f"{reader.path}: no topic of it is exposed by the configuration")
        if not node.runtime.run(lambda: node.member.attachment.is_attached, time.monotonic() + ATTACH_S):
            raise LocalError(f"no switch answered on {settings.iface} within {ATTACH_S:g} s")
        refused = [each for each in node.member.attachment.advertisements if each.refused is not None]
        for each in refused:
            log.warning("advertisement refused name=%s reason=%s", each.subject.name.short, each.refused)
        if json:
            emit("ready", name=node.member.name.to_text())
        for topic in replay.wait_for_readers(wait_s):
            log.warning("no reader topic=%s", topic)
        is_whole = replay.run() and replay.finish()
        report()
        unconfirmed = replay.unconfirmed()
        _report(reader, replay, unconfirmed, json=json)
        node.leave()
    return is_whole and not (unconfirmed or refused or replay.too_large or reader.missing)


def _report_progress(replay: Replay, total: int | None) -> None:
    emit(
        "progress",
        sent=replay.sent,
        total=total,
        bytes=replay.sent_bytes,
        confirmed=replay.confirmed,
        unconfirmed={each.topic: each.messages - each.confirmed for each in replay.unconfirmed()},
    )


def _exposed_total(reader: BagReader, endpoint: ReplayEndpoint) -> int | None:
    """Return the number of exposed messages of the recording; None where its index does not state it."""
    if all(endpoint.is_subscribed(index) for index in range(len(reader.channels))):
        return reader.count
    if reader.counts is None:
        return None
    return sum(count for index, count in enumerate(reader.counts) if endpoint.is_subscribed(index))


def _report(reader: BagReader, replay: Replay, unconfirmed: Sequence[Unconfirmed], *, json: bool) -> None:
    if json:
        emit(
            "done",
            sent=replay.sent,
            confirmed=replay.confirmed,
            best_effort=replay.sent_best_effort,
            best_effort_topics=[each.to_fields() for each in replay.best_effort()],
            unconfirmed=[asdict(each) for each in unconfirmed],
            held=[asdict(each) for each in replay.held()],
            topics=_topic_fields(replay),
            unread=reader.unread or None,
            missing=reader.missing,
        )
        return
    confirming = [each for each in replay.topics if each.publisher.confirms]
    reliable = sum(each.flow.published.total() for each in confirming)
    lines = [f"{reliable} messages sent, {replay.confirmed} confirmed"] if confirming else []
    best_effort = replay.best_effort()
    if best_effort:
        lines.append(f"{replay.sent_best_effort} messages sent best effort, not confirmed")
    echo("; ".join(lines) or "0 messages sent")
    for words in [each.words() for each in best_effort] + [each.words() for each in replay.held()]:
        echo(f"  {words}")
    if reader.unread:
        echo(f"not all of the recording could be read: {reader.unread}", err=True)
    for each in unconfirmed:
        echo(each.words(), err=True)


def _topic_fields(replay: Replay) -> list[dict[str, object]]:
    """Return the statistics of each channel that sent a message, in the recording's order."""
    channels = [(index, number, each) for each in replay.topics for number, index in enumerate(each.indexes)]
    return [
        {
            "topic": each.topic,
            "type": each.type_name,
            "messages": each.flow.published[number],
            "bytes": each.flow.published_bytes[number],
            "reliable": each.publisher.confirms,
        }
        for _, number, each in sorted(channels, key=lambda channel: channel[0])
        if each.flow.published[number]
    ]


if __name__ == "__main__":
    main()
