"""The ``gdp-proxy`` command.

Place: command.
"""

from __future__ import annotations

import contextlib
import logging
import time
from typing import Final

import typer

from gdp.cli.node import Check, Config, Json, Verbose, emit, failing_clearly, set_up_logging
from gdp.crypto.certificates import Role
from gdp.nodes.membership import load_member
from proxy.config import ProxyConfig
from proxy.endpoints.bag import BagWriter
from proxy.inbound import Inbound
from proxy.node import ProxyNode, open_topics, run_node

__all__ = ["main"]

log = logging.getLogger(__name__)

TICK_S: Final = 0.5
GOODBYE_S: Final = 0.2

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command(epilog="Example: gdp-proxy --config proxy.yaml --check")
def proxy(config: Config, check: Check = False, json: Json = False, verbose: Verbose = False) -> None:
    """Receive the topics that the configuration imports, and record them, until Ctrl-C."""
    set_up_logging(verbose=verbose)
    with failing_clearly():
        settings = ProxyConfig.load(config)
        if check:
            check_proxy(settings, json=json)
            return
        with run_node(settings) as node, contextlib.ExitStack() as stack:
            writer = None
            if settings.record is not None:
                writer = BagWriter(settings.record.path, 1 if settings.record.format == "ros1" else 2)
                stack.callback(writer.close)
            inbound = Inbound(node, settings.imports, writer)
            for rule in settings.imports:
                node.member.subscribe(node.topics[rule.overlay_name])
            _work(node, inbound, json=json)
            node.member.leave()
            node.linger(GOODBYE_S)
            stack.close()
            if json:
                emit("done", topics=inbound.to_fields())
            else:
                typer.echo(f"{inbound.received} messages received, {inbound.lost} lost")


def check_proxy(settings: ProxyConfig, *, json: bool) -> None:
    """Say what a configuration means, or raise what is wrong with it."""
    identity, _ = load_member(settings.identity, settings.domain, Role.PROXY)
    open_topics(settings, identity)
    for direction, rules in (("expose", settings.expose), ("import", settings.imports)):
        for rule in rules:
            if json:
                emit("rule", direction=direction, topic=rule.name, name=rule.overlay_name.to_text())
            else:
                typer.echo(f"{direction} {rule.name} [{rule.type_name}] as {rule.overlay_name.to_text()}")
    if json:
        emit("checked", name=identity.name.to_text())
    else:
        typer.echo(f"configuration good: proxy {identity.name.short}")


def _work(node: ProxyNode, inbound: Inbound, *, json: bool) -> None:
    """Receive until stopped, telling of progress."""
    is_ready = False
    tick_at_s = 0.0
    while not node.runtime.is_stopped:
        node.runtime.step(max(tick_at_s, time.monotonic()))
        inbound.take()
        if not is_ready and node.member.attachment.is_attached:
            is_ready = True
            _tell_refusals(node)
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


def _tell_refusals(node: ProxyNode) -> None:
    for each in node.member.attachment.claims:
        if each.refused is not None:
            name, right, reason = each.subject.name.short, each.right.value, each.refused.label
            log.warning("claim refused name=%s right=%s reason=%s", name, right, reason)


def main() -> None:
    """Run the command."""
    app()


if __name__ == "__main__":
    main()
