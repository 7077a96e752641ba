"""``--check``: what a configuration means, without taking part in the overlay.

Place: shell.
"""

from __future__ import annotations

import typer

from gdp.cli.node import emit
from gdp.crypto.certificates import Role
from gdp.nodes.membership import load_member
from proxy.config import ProxyConfig
from proxy.held import Held
from proxy.node import open_topics

__all__ = ["check_proxy"]


def check_proxy(settings: ProxyConfig, *, json: bool) -> None:
    """Say what a configuration means, or raise what is wrong with it."""
    identity, _ = load_member(settings.identity, settings.domain, Role.PROXY)
    held = Held(settings.delegations, identity)
    open_topics(settings, held)
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
