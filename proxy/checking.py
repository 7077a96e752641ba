"""``--check``: what a configuration means here and now, without taking part in the overlay.

Place: shell.
"""

from __future__ import annotations

import select
import time
from collections.abc import Mapping, Sequence
from typing import Final

from rich.console import Console

from gdp.cli.node import emit
from gdp.crypto.certificates import Role
from gdp.names import Name
from gdp.nodes.membership import load_member
from gdp.trust.delegation import Delegation
from proxy.config import ProxyConfig
from proxy.endpoints.endpoint import Endpoint, GraphChanged, proxy_node_name
from proxy.endpoints.live import open_endpoints
from proxy.explain import explain
from proxy.explain_table import table
from proxy.finding import Finding
from proxy.held import Held
from proxy.node import open_topics
from proxy.rules.rule import Rule

__all__ = ["check_proxy"]

LOOK_S: Final = 3.0  # at most; discovery of a graph takes a second or two
QUIET_S: Final = 1.0  # a graph that has not changed for so long is known


def check_proxy(settings: ProxyConfig, *, json: bool) -> None:
    """Say what each rule means.

    Raises:
        LocalError: without a live graph, a rule that has no delegation; with one, a graph that cannot be looked at.
    """
    identity, _ = load_member(settings.identity, settings.domain, Role.PROXY)
    held = Held(settings.delegations, identity)
    delegations = {topic.name: topic.delegation for topic in held}
    if settings.ros:
        with open_endpoints(settings.ros, proxy_node_name(identity.name.to_text(), "check")) as endpoints:
            for endpoint in endpoints:
                _look(endpoint)
            for at, endpoint in enumerate(endpoints):
                _tell(endpoint.label, _findings(settings, at, endpoint, delegations), json=json)
    else:
        open_topics(settings, held)
        _tell("", explain(settings.expose, settings.imports, None, delegations), json=json)
    if json:
        emit("checked", name=identity.name.to_text())
    else:
        Console().print(f"configuration good: proxy {identity.name.short}", highlight=False)


def _look(endpoint: Endpoint) -> None:
    """Wait until a graph is known: it answered, and nothing new came for a while."""
    end_s, quiet_s = time.monotonic() + LOOK_S, time.monotonic() + QUIET_S
    while (now_s := time.monotonic()) < min(end_s, quiet_s):
        if not select.select([endpoint], [], [], min(end_s, quiet_s) - now_s)[0]:
            return
        if any(isinstance(event, GraphChanged) for event in endpoint.take()):
            quiet_s = time.monotonic() + QUIET_S


def _findings(
    settings: ProxyConfig, at: int, endpoint: Endpoint, delegations: Mapping[Name, Delegation]
) -> list[Finding]:
    def of(rules: Sequence[Rule]) -> list[Rule]:
        return [rule for rule in rules if settings.endpoint_of(rule) == at]

    return explain(of(settings.expose), of(settings.imports), endpoint.graph(), delegations)


def _tell(label: str, findings: Sequence[Finding], *, json: bool) -> None:
    if json:
        for finding in findings:
            emit("rule", graph=label, **finding.to_fields())
        return
    console = Console()
    if label:
        console.print(label, style="bold", highlight=False)
    console.print(table(findings))
