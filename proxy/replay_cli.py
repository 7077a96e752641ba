"""The ``gdp-replay`` command.

Place: command.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import typer

from gdp.cli.node import Check, Config, Json, Verbose, emit, emit_wait, failing_clearly, set_up_logging
from gdp.cli.version import Version
from gdp.errors import LocalError
from proxy.checking import check_proxy
from proxy.config import ProxyConfig
from proxy.endpoints.bag import BagLimits, BagReader, RecordingError
from proxy.held import Held
from proxy.node import GOODBYE_S, ProxyNode, open_topics, renew_topics, run_node
from proxy.outbound import Outbound
from proxy.replayer import Played, Replayer, Unconfirmed

__all__ = ["main"]

log = logging.getLogger(__name__)

ATTACH_PATIENCE_S: Final = 30.0

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command(epilog="Example: gdp-replay drive.mcap --config proxy.yaml --rate 2")
def replay(
    bag: Annotated[Path, typer.Argument(help="A ROS 1 bag, an MCAP file, a .db3 file or a rosbag2 folder.")],
    config: Config,
    rate: Annotated[float, typer.Option(min=0.0, help="1: as recorded; 0: as fast as readers confirm.")] = 1.0,
    wait_readers: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for a reader of every topic.")] = 15.0,
    memory: Annotated[
        int | None,
        typer.Option(min=64, metavar="MIB", help="Memory to decode the recording; 1 to 4 GiB, by its length."),
    ] = None,
    cpu: Annotated[
        float | None,
        typer.Option(min=1.0, metavar="SECONDS", help="Processor time to decode it; 30 s and 2 s for each MiB."),
    ] = None,
    check: Check = False,
    json: Json = False,
    verbose: Verbose = False,
    version: Version = False,
) -> None:
    """Replay a recording's exposed topics onto the overlay with the recorded timing.

    Exit 1: a message of a reliable topic was not confirmed by every reader of it, or had none, latched or not; or was
    too large, or the overlay refused a topic; or the recording takes more memory or time than it may. Best effort is
    sent, and confirmed by nobody.
    """
    del version  # it ends the command by itself
    set_up_logging(verbose=verbose)
    limits = BagLimits(None if memory is None else memory << 20, cpu)
    with failing_clearly(), _failing_decoder():
        settings = ProxyConfig.load(config)
        with BagReader(bag, limits) as reader:
            if check:
                check_proxy(settings, json=json)
                return
            with run_node(settings, emit_wait if json else None) as node:
                is_complete = _replay(node, reader, settings, rate, wait_readers, json=json)
    raise typer.Exit(0 if is_complete else 1)


@contextlib.contextmanager
def _failing_decoder() -> Iterator[None]:
    """Turn the end of the process that decodes into one line on standard error and exit code 1."""
    try:
        yield
    except RecordingError as error:
        hint = f" (see --{error.limit})" if error.limit else ""
        typer.echo(f"error: {error}{hint}", err=True)
        raise typer.Exit(1) from error


def _replay(
    node: ProxyNode, reader: BagReader, settings: ProxyConfig, rate: float, wait_s: float, *, json: bool
) -> bool:
    topics = open_topics(settings, Held(settings.delegations, node.identity))
    node.on_reload = partial(renew_topics, node, settings)
    outbound = Outbound(node, settings.expose, topics, reader.channels)
    if not outbound.publishers:
        raise LocalError(f"{reader.path}: no topic of it is exposed by the configuration")
    if not node.runtime.run(lambda: node.member.attachment.is_attached, time.monotonic() + ATTACH_PATIENCE_S):
        raise LocalError(f"no switch answered on {settings.iface} within {ATTACH_PATIENCE_S:g} s")
    refused = [each for each in node.member.attachment.claims if each.refused is not None]
    for each in refused:
        log.warning("claim refused name=%s reason=%s", each.subject.name.short, each.refused)
    if json:
        emit("ready", name=node.member.name.to_text())

    total = _exposed_total(reader, outbound)

    def tick(played: Played) -> None:
        if json:
            emit(
                "progress",
                sent=played.sent,
                total=total,
                bytes=played.sent_bytes,
                confirmed=replayer.confirmed,
                unconfirmed={each.topic: each.messages - each.confirmed for each in replayer.unconfirmed()},
            )

    replayer = Replayer(node, reader, outbound, rate, tick)
    for topic in replayer.wait_for_readers(wait_s):
        log.warning("nobody reads topic=%s", topic)
    is_whole = replayer.play() and replayer.finish()
    tick(replayer.played)
    unconfirmed = replayer.unconfirmed()
    is_complete = is_whole and not (unconfirmed or refused or outbound.too_large)
    _report(reader, replayer, outbound, unconfirmed, json=json)
    node.member.leave()
    node.linger(GOODBYE_S)
    return is_complete


def _exposed_total(reader: BagReader, outbound: Outbound) -> int | None:
    """Return how many messages of the recording are exposed; None where its index does not say."""
    if all(outbound.is_exposed(at) for at in range(len(reader.channels))):
        return reader.count
    if reader.counts is None:
        return None
    return sum(count for at, count in enumerate(reader.counts) if outbound.is_exposed(at))


def _report(
    reader: BagReader, replayer: Replayer, outbound: Outbound, unconfirmed: Sequence[Unconfirmed], *, json: bool
) -> None:
    played = replayer.played
    confirming = {
        at for topic, each in outbound.publishers.items() if each.confirms for at in outbound.channels_of[topic]
    }
    topics = [
        {
            "topic": channel.topic,
            "type": channel.type_name,
            "messages": played.by_channel[at],
            "bytes": played.bytes_by_channel[at],
            "reliable": at in confirming,
        }
        for at, channel in enumerate(reader.channels)
        if played.by_channel[at]
    ]
    if json:
        emit(
            "done",
            sent=played.sent,
            confirmed=replayer.confirmed,
            best_effort=replayer.sent_best_effort,
            unconfirmed=[asdict(each) for each in unconfirmed],
            topics=topics,
            unread=reader.unread or None,
        )
        return
    reliable = sum(played.by_channel[at] for at in confirming)
    told = [f"{reliable} messages sent, {replayer.confirmed} confirmed"] if confirming else []
    if reliable < played.sent:
        told.append(f"{played.sent - reliable} messages sent, best effort")
    typer.echo("; ".join(told) or "0 messages sent")
    if reader.unread:
        typer.echo(f"the recording could not be read to its end: {reader.unread}", err=True)
    for each in unconfirmed:
        typer.echo(each.words(), err=True)


def main() -> None:
    """Run the command."""
    app(prog_name="gdp-replay")


if __name__ == "__main__":
    main()
