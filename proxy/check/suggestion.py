"""Suggested ``proxy.yaml``: a commented rule for each topic, service and action of a live graph.

Sans-I/O. Every rule is a comment, so nothing leaves the machine before a person has read it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from gdp.printable import printable
from gdp.ros_names import Kind, is_of_every_node
from proxy.bridge.core.action_interface import action_of
from proxy.endpoints.core.endpoint import Graph, Role

_OFFERS: Final[dict[Role, Kind]] = {Role.PUBLISHES: "topic", Role.SERVES: "service"}


@dataclass(frozen=True, slots=True)
class Traffic:
    """Messages of a topic that came within a time: number, bytes in all, seconds."""

    messages: int
    size: int
    seconds: float

    def to_text(self) -> str:
        """Return rate and mean size for people."""
        if not self.messages:
            return f"no message in {self.seconds:g} s"
        return f"{self.messages / self.seconds:.3g} Hz, {_bytes(self.size / self.messages)} each"


@dataclass(frozen=True, slots=True, kw_only=True)
class Offered:
    """A name that local nodes publish or serve.

    Args:
        kind: ``topic``, ``service`` or ``action``.
        nodes: those that publish or serve it.
        traffic: of a topic that could be read.
    """

    kind: Kind
    name: str
    type_name: str
    nodes: tuple[str, ...]
    traffic: Traffic | None = None

    @property
    def note(self) -> str:
        """Return its traffic for people."""
        return "" if self.traffic is None else self.traffic.to_text()


def offered_names(graph: Graph) -> list[Offered]:
    """Return what nodes of a graph publish and serve, except the services and topics that every node has."""
    found: dict[tuple[Kind, str, str], list[str]] = {}
    for each in graph:
        kind = _OFFERS.get(each.role)
        if each.is_proxy or not each.type_name or kind is None:
            continue
        if kind == "service" and (action := action_of(each)):
            found.setdefault(("action", *action), []).append(each.node)
        elif "/_" not in each.name and not is_of_every_node(kind, each.name):
            found.setdefault((kind, each.name, each.type_name), []).append(each.node)
    return [
        Offered(kind=kind, name=name, type_name=type_name, nodes=tuple(sorted(set(nodes))))
        for (kind, name, type_name), nodes in sorted(found.items())
    ]


def suggested_file(offered: Sequence[Offered], endpoint: str, label: str) -> str:
    """Return the text of ``proxy.yaml``, for keys as ``gdp lab`` lays them out.

    Args:
        endpoint: word of ``ros``, such as ``dds``.
        label: the graph that was observed, for the first comment.
    """
    lines = [
        f"# Suggested from the graph {label}. Each rule below is a comment: delete the '#' in front of what may leave",
        "# this machine, then give the proxy the right to it: gdp-delegate --owner OWNER_DIR proxy.yaml",
        "identity: proxy",
        "domain: {root: proxy/root.crt}",
        "delegations: proxy/delegations",
        "iface: proxy0",
        f"ros: {{endpoint: {endpoint}}}",
        "",
        "# expose:",
    ]
    for each in offered:
        about = "; ".join(filter(None, (each.note, f"from {', '.join(filter(None, each.nodes)) or 'an unnamed node'}")))
        kind = "" if each.kind == "topic" else f", kind: {each.kind}"
        lines.append(f"#   # {printable(about)}")
        lines.append(f"#   - {{name: {_word(each.name)}, type: {_word(each.type_name)}{kind}, owner: owner.pub}}")
    if not offered:
        lines.append("#   # no node published or served anything; start your nodes, then: gdp up DIR --suggest")
    return "\n".join([*lines, ""])


def _word(text: str) -> str:
    """Return a remote node's text as one YAML word, which cannot end its line."""
    return text if text.isascii() and all(each.isalnum() or each in "/_" for each in text) else json.dumps(text)


def _bytes(size: float) -> str:
    for unit, factor in (("MiB", 1 << 20), ("KiB", 1 << 10)):
        if size >= factor:
            return f"{size / factor:.3g} {unit}"
    return f"{size:.0f} bytes"
