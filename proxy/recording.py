"""A proxy without a live graph: what is imported is recorded, or only counted.

Place: shell.
"""

from __future__ import annotations

import contextlib
import time
from functools import partial
from typing import Final

import typer

from gdp.cli.node import emit, emit_wait
from gdp.errors import LocalError
from proxy.config import ProxyConfig
from proxy.held import Held
from proxy.inbound import Inbound
from proxy.node import GOODBYE_S, ProxyNode, open_topics, renew_topics, run_node
from proxy.recordings.writer import BagWriter

__all__ = ["record", "refuse_existing_file"]

TICK_S: Final = 0.5


def record(settings: ProxyConfig, *, json: bool) -> None:
    """Receive what the configuration imports until stopped.

    Raises:
        LocalError: keys, delegations, the device or the file are not as the configuration says.
    """
    refuse_existing_file(settings)
    with run_node(settings, emit_wait if json else None) as node, contextlib.ExitStack() as stack:
        topics = open_topics(settings, Held(settings.delegations, node.identity))
        node.on_reload = partial(renew_topics, node, settings)
        writer = None
        if settings.record is not None:
            writer = BagWriter(settings.record.path, 1 if settings.record.format == "ros1" else 2)
            stack.callback(writer.close)
        inbound = Inbound(node, settings.imports, writer)
        for rule in settings.imports:
            node.member.subscribe(topics[rule.overlay_name])
        _work(node, inbound, json=json)
        node.member.leave()
        node.linger(GOODBYE_S)
        stack.close()
        if json:
            emit("done", topics=inbound.to_fields())
        else:
            typer.echo(f"{inbound.received} messages received, {inbound.lost} lost")
            for tally in inbound.tallies.values():
                if tally.lost:
                    refused = f", {tally.refused} not handed over" if tally.refused else ""
                    typer.echo(f"  {tally.topic}: {tally.received} received, {tally.losses.words()}{refused}")


def refuse_existing_file(settings: ProxyConfig) -> None:
    """Refuse to record into a file that exists.

    Raises:
        LocalError: it does.
    """
    if settings.record is not None and settings.record.path.exists():
        raise LocalError(f"{settings.record.path} exists already; move or delete it, or change record.path")


def _work(node: ProxyNode, inbound: Inbound, *, json: bool) -> None:
    """Receive until stopped, telling of progress."""
    is_ready = False
    tick_at_s = 0.0
    while not node.runtime.is_stopped:
        node.runtime.step(max(tick_at_s, time.monotonic()))
        inbound.take()
        if not is_ready and node.member.attachment.is_attached:
            is_ready = True
            node.tell_refusals()
            if json:
                emit("ready", name=node.member.name.to_text())
            else:
                typer.echo(f"proxy {node.member.name.short} is attached; Ctrl-C ends it")
        if time.monotonic() >= tick_at_s:
            tick_at_s = time.monotonic() + TICK_S
            if json and is_ready:
                latest = [tally.latencies_ms[-1] for tally in inbound.tallies.values() if tally.latencies_ms]
                emit(
                    "progress",
                    received=inbound.received,
                    lost=inbound.lost,
                    latency_ms=round(sum(latest) / len(latest), 3) if latest else None,
                )
