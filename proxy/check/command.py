"""Check command: ``--check`` reports what a configuration means here and now, without joining the overlay.

I/O.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Console

from gdp.cli.node import emit
from gdp.crypto.certificates import Role
from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore
from gdp.nodes.membership import load_member
from gdp.trust.delegation import Delegation
from proxy.check.explain import explain
from proxy.check.finding import Finding
from proxy.check.graph_snapshot import read_graphs
from proxy.check.table import table
from proxy.config.config import ProxyConfig
from proxy.config.rule import Rule
from proxy.endpoints.endpoint import Graph
from proxy.node.node import open_topics

__all__ = ["check_proxy"]


def check_proxy(settings: ProxyConfig, *, json: bool) -> None:
    """Print the meaning of each rule.

    Raises:
        LocalError: without a live graph, a rule has no delegation; with one, a graph cannot be queried.
    """
    identity, _ = load_member(settings.identity, settings.domain, Role.PROXY)
    held = DelegationStore(settings.delegations, identity)
    delegations = {topic.name: topic.delegation for topic in held}
    if settings.ros:
        for at, (label, graph) in enumerate(read_graphs(settings.ros, identity.name.to_text(), "check")):
            _tell(label, _findings(settings, at, graph, delegations), json=json)
    else:
        open_topics(settings, held)
        _tell("", explain(settings.expose, settings.imports, None, delegations), json=json)
    if json:
        emit("checked", name=identity.name.to_text())
    else:
        Console().print(f"configuration good: proxy {identity.name.short}", highlight=False)


def _findings(settings: ProxyConfig, at: int, graph: Graph, delegations: Mapping[Name, Delegation]) -> list[Finding]:
    def of(rules: Sequence[Rule]) -> list[Rule]:
        return [rule for rule in rules if settings.endpoint_of(rule) == at]

    return explain(of(settings.expose), of(settings.imports), graph, delegations)


def _tell(label: str, findings: Sequence[Finding], *, json: bool) -> None:
    if json:
        for finding in findings:
            emit("rule", graph=label, **finding.to_fields())
        return
    console = Console()
    if label:
        console.print(label, style="bold", highlight=False)
    console.print(table(findings))
