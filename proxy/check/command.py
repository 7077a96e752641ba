"""Check command: ``--check`` reports what a configuration means here and now, without joining the overlay."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from rich.console import Group
from rich.table import Table
from rich.text import Text

from gdp.cli.console import console
from gdp.cli.node import emit
from gdp.crypto.certificates import Role
from gdp.names import Name
from gdp.nodes.delegation_store import DelegationStore
from gdp.nodes.membership import load_member
from gdp.printable import escaped
from gdp.trust.delegation import Delegation
from proxy.check.core.explain import explain, unknown_qos
from proxy.check.core.finding import Finding, Match
from proxy.check.graph_snapshot import read_graphs
from proxy.config.config import ProxyConfig
from proxy.config.rule import Rule
from proxy.endpoints.core.endpoint import Graph
from proxy.node.node import open_topics


def check_proxy(path: Path, settings: ProxyConfig, *, json: bool) -> int:
    """Print the meaning of each rule; return how many names here lack a delegation.

    Args:
        path: of the configuration, for the advice.

    Raises:
        LocalError: without a live graph, a rule has no delegation; with one, a graph cannot be queried.
    """
    identity, _ = load_member(settings.identity, settings.domain, Role.PROXY)
    held = DelegationStore(settings.delegations, identity)
    delegations = {topic.name: topic.delegation for topic in held}
    lacking, without_qos = 0, unknown_qos(settings.imports) if settings.ros else []
    if settings.ros:
        for at, (label, graph) in enumerate(read_graphs(settings.ros, identity.name.to_text(), "check")):
            findings = _findings(settings, at, graph, delegations)
            lacking += _lacking(findings)
            _tell(label, findings, json=json)
    else:
        open_topics(settings, held)
        _tell("", explain(settings.expose, settings.imports, None, delegations), json=json)
    if json:
        emit("checked", name=identity.name.to_text(), undelegated=lacking, unknown_qos=without_qos)
        return lacking
    if without_qos:
        shown = ", ".join(without_qos)
        console().print(
            f"import {shown}: reliable and volatile until a publisher is known; 'offered' states another QoS"
        )
    if lacking:
        names = "1 name lacks a delegation" if lacking == 1 else f"{lacking} names lack a delegation"
        console().print(
            f"configuration valid: proxy {identity.name.short}, but {names};"
            f" the owner makes it with: gdp delegate --owner OWNER --live {path}"
        )
    else:
        console().print(f"configuration good: proxy {identity.name.short}")
    return lacking


def _lacking(findings: Sequence[Finding]) -> int:
    return sum(each.overlay is not None and not each.is_held for finding in findings for each in finding.matches)


def _findings(settings: ProxyConfig, at: int, graph: Graph, delegations: Mapping[Name, Delegation]) -> list[Finding]:
    def of(rules: Sequence[Rule]) -> list[Rule]:
        return [rule for rule in rules if settings.endpoint_of(rule) == at]

    return explain(of(settings.expose), of(settings.imports), graph, delegations)


def _tell(label: str, findings: Sequence[Finding], *, json: bool) -> None:
    if json:
        for finding in findings:
            emit("rule", graph=label, **finding.to_fields())
        return
    shown = console()
    if label:
        shown.print(label, style="bold")
    shown.print(table(findings))


def table(findings: Sequence[Finding]) -> Group:
    """Return one row for each name under each rule, then one line for each fault and note."""
    drawn = Table(title="rules", title_justify="left", title_style="bold")
    for heading in ("rule", "here", "type", "nodes", "QoS"):
        drawn.add_column(heading, overflow="fold")
    for heading in ("name", "allowed"):
        drawn.add_column(heading, overflow="fold")
    for finding in findings:
        rule = Text(f"{finding.direction} {finding.kind} {finding.name}")
        if not finding.matches:
            drawn.add_row(rule, "-", style="dim")
        for match in finding.matches:
            drawn.add_row(rule, *(Text(escaped(each)) for each in _cells(match)), style=_style(match))
    return Group(drawn, *_lines(findings))


def _cells(match: Match) -> tuple[str, ...]:
    return (
        match.local,
        match.type_name or "?",
        "\n".join(match.nodes) or "-",
        "\n".join(match.qos) or "-",
        match.overlay.short if match.overlay is not None else "-",
        "yes" if match.is_held else "no",
    )


def _style(match: Match) -> str | None:
    return "red" if match.faults else None if match.nodes else "dim"


def _lines(findings: Sequence[Finding]) -> Iterator[Text]:
    for finding in findings:
        for match in finding.matches:
            for text in match.faults:
                yield Text(f"{finding.direction} {match.local}: {text}", style="red")
            for text in match.notes:
                yield Text(f"{finding.direction} {match.local}: {text}")
        for text in finding.notes:
            yield Text(f"{finding.direction} {finding.name}: {text}")
