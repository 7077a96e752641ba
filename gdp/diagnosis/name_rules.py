"""Rules about the names, types and nodes at both ends.

Sans-I/O. Each rule returns sentence and command where its cause holds, else None.
"""

from __future__ import annotations

import shlex
from difflib import get_close_matches
from typing import Final

from gdp.diagnosis.network_rules import Found
from gdp.diagnosis.view import End, View, short

__all__ = [
    "graph_away",
    "local_type_differs",
    "metadata_differs",
    "name_unknown",
    "no_advertiser",
    "no_publisher",
    "no_reader_here",
    "no_server",
    "not_exposed",
    "not_imported",
    "owner_differs",
    "replicas_silent",
    "rival_proxy",
    "ros_domain_differs",
    "shared_memory_only",
    "type_differs",
    "type_support_missing",
]

_CHECK: Final = "gdp-proxy --config proxy.yaml --check"


def name_unknown(view: View) -> Found:
    """No rule names it, and a name that is spelt almost like it exists."""
    if view.near is None or view.near_ends:
        return None
    known = [each for each in view.near.known if each != view.facts.asked]
    close = get_close_matches(view.facts.asked, known, n=1, cutoff=0.75)
    if not close:
        return None
    return f"No rule names {view.facts.asked}; did you mean {close[0]}?", f"gdp explain {shlex.quote(close[0])}"


def not_imported(view: View) -> Found:
    """No rule of the near proxy names it."""
    if view.near is None or view.near_ends:
        return None
    name = shlex.quote(view.facts.asked)
    far = next((each for proxy in view.far_proxies for each in proxy.flows if each.side == "import"), None)
    if far is not None:
        return f"No rule of the proxy here exposes {name}, which another proxy imports.", f"gdp expose {name} --help"
    return f"No rule of the proxy here names {name}, so it stays local.", f"gdp import {name} --help"


def type_support_missing(view: View) -> Found:
    """A machine does not know the type."""
    for end in view.ends:
        if end.flow.problem == "unknown-type" or (end.flow.faults.get("unknown-type") and not end.flow.received):
            package = end.flow.type_name.partition("/")[0] or "PACKAGE"
            text = (
                f"ROS does not know the type {end.flow.type_name} {end.place}: its package is not installed or sourced."
            )
            return text, f"ros2 interface show {end.flow.type_name or package}"
    return None


def local_type_differs(view: View) -> Found:
    """Local nodes use the name with another type than the rule's, or the far definition differs."""
    for end in view.ends:
        flow = end.flow
        if flow.other_types and not flow.nodes:
            text = f"Nodes {end.place} use {flow.local} as {flow.other_types[0]}; the rule says {flow.type_name}."
            return text, f"ros2 topic info -v {flow.local}"
        if "other-type" in flow.details and not flow.received:
            text = f"The types differ {end.place}: {flow.details['other-type']}."
            return text, f"ros2 interface show {flow.type_name}"
    return None


def graph_away(view: View) -> Found:
    """A ROS graph cannot be had."""
    for end in view.ends:
        if end.flow.problem == "no-graph":
            return f"The ROS graph {end.place} cannot be had: {end.flow.detail}.", _CHECK
    return None


def rival_proxy(view: View) -> Found:
    """Another proxy of the same graph carries the name."""
    for end in view.ends:
        if end.flow.problem == "other-bridge":
            text = (
                f"Another proxy carries {end.flow.local} in the same ROS graph, so the one {end.place} leaves it alone"
            )
            return f"{text}: {end.flow.detail}.", "ros2 node list"
    return None


def ros_domain_differs(view: View) -> Found:
    """ROS nodes of this host are in another ROS domain, and none is in the proxy's."""
    wanted, end = view.facts.graph_domain, _deserted(view)
    if wanted is None or end is None:
        return None
    here = [each for each in view.facts.processes if not each.is_apart]
    others = [each for each in here if each.domain != wanted]
    if not others or len(others) < len(here):
        return None
    text = (
        f"{others[0].command} (process {others[0].pid}) is in ROS domain {others[0].domain}; the proxy is in {wanted}."
    )
    return text, f"export ROS_DOMAIN_ID={wanted}"


def shared_memory_only(view: View) -> Found:
    """A ROS node of this host speaks shared memory only, which the proxy does not hear."""
    if _deserted(view) is None:
        return None
    for each in view.facts.processes:
        if each.transports.upper().startswith("SHM") and not each.is_apart:
            text = f"{each.command} (process {each.pid}) offers shared memory only, and the proxy does not hear it."
            return text, "export FASTDDS_BUILTIN_TRANSPORTS=UDPv4"
    return None


def no_reader_here(view: View) -> Found:
    """No local node reads an imported topic."""
    for end in view.importers:
        flow = end.flow
        if flow.kind == "topic" and not flow.nodes and flow.is_carried and end.proxy.entities is not None:
            text = f"No node {end.place} subscribes to {flow.local}, so the proxy does not fetch it."
            return text, f"ros2 topic echo {flow.local}"
    return None


def no_publisher(view: View) -> Found:
    """No local node publishes an exposed topic."""
    for end in view.exporters:
        if end.flow.kind == "topic" and not end.flow.nodes and end.proxy.entities is not None:
            return f"No node {end.place} publishes {end.flow.local}.", f"ros2 topic info -v {end.flow.local}"
    withdrew = [each for rib in view.facts.ribs for each in rib.gone if each.how == "withdrew"]
    if withdrew and not view.advertisers and not view.is_service:
        text = f"Its last publisher left: proxy {short(withdrew[-1].advertiser)} withdrew the name."
        return text, f"ros2 topic info -v {view.facts.asked}"
    return None


def no_server(view: View) -> Found:
    """No node serves a service."""
    for end in view.exporters:
        if end.flow.kind != "topic" and not end.flow.nodes:
            return f"No node {end.place} serves {end.flow.local}.", f"ros2 service type {end.flow.local}"
    if view.is_service and not view.exporters and not view.advertisers and view.facts.ribs:
        return f"No machine serves {view.facts.asked} now.", f"ros2 service type {view.facts.asked}"
    return None


def replicas_silent(view: View) -> Found:
    """Servers are known, and none answers any more."""
    for end in view.importers:
        flow = end.flow
        if flow.kind != "topic" and not flow.connected and (flow.silent or flow.writers):
            count = max(flow.silent, flow.writers)
            which = f"All {count} known servers" if count > 1 else "The server"
            text = f"{which} of {flow.local} stay silent"
            return f"{text}: they stopped, or the path to them loses everything.", f"gdp ping {flow.local}"
    return None


def type_differs(view: View) -> Found:
    """The far side has the same ROS name with another type."""
    return _namesake(view, "type_name", "type")


def owner_differs(view: View) -> Found:
    """The far side has the same ROS name of another owner."""
    for end in _namesakes(view):
        ours = view.near_ends[0].flow
        if end.flow.owner != ours.owner:
            text = (
                f"The rules name different owners for {ours.local}"
                f" ({ours.owner[:6]} here, {end.flow.owner[:6]} {end.place})"
            )
            return f"{text}, so their 256-bit names differ.", "gdp name --help"
    return None


def metadata_differs(view: View) -> Found:
    """The far side has the same ROS name with other metadata."""
    for end in _namesakes(view):
        ours = view.near_ends[0].flow
        if end.flow.digest != ours.digest:
            text = f"The metadata or salt of {ours.local} differ here and {end.place}, so their 256-bit names differ."
            return text, _CHECK
    return None


def not_exposed(view: View) -> Found:
    """No far proxy that could be asked has a rule that exposes it."""
    if not view.importers or view.exporters or view.advertisers:
        return None
    if view.far_proxies and not any(each.flow.side == "expose" for each in view.namesakes):
        whose = short(view.far_proxies[0].name)
        text = f"No rule of proxy {whose} exposes {view.facts.asked}."
        return text, f"gdp expose {shlex.quote(view.facts.asked)} --help"
    return None


def no_advertiser(view: View) -> Found:
    """RIB and switches know no advertiser, and no far proxy could be asked."""
    knows = view.facts.ribs or any(each.is_negative for each in view.facts.switches)
    if view.importers and not view.exporters and not view.advertisers and knows:
        text = (
            "No proxy advertises this name: it is not exposed, nothing publishes it, or type, metadata or owner differ."
        )
        return text, _CHECK
    return None


def _deserted(view: View) -> End | None:
    """Return a near end whose local nodes are missing."""
    for end in view.near_ends:
        if not end.flow.nodes and end.proxy.entities is not None:
            return end
    return None


def _namesakes(view: View) -> list[End]:
    """Return far ends of the other side with the same ROS name, where no far end has the same overlay name."""
    far_same = [each for each in view.ends if not each.proxy.is_near]
    if far_same or not view.near_ends or view.advertisers:
        return []
    side = view.near_ends[0].flow.side
    return [each for each in view.namesakes if each.flow.side != side]


def _namesake(view: View, field: str, word: str) -> Found:
    for end in _namesakes(view):
        ours, theirs = getattr(view.near_ends[0].flow, field), getattr(end.flow, field)
        if ours and theirs and ours != theirs:
            text = f"The {word} differs: {ours} here, {theirs} {end.place}, so their 256-bit names differ."
            return text, _CHECK
    return None
