"""Rules about the names, types and nodes at both ends.

Sans-I/O. Each rule yields sentence and command where its cause holds; the first counts.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from difflib import get_close_matches
from typing import Final

from gdp.diagnosis.answer import Cause
from gdp.diagnosis.view import End, Found, Rule, View, short

_CHECK: Final = "gdp-proxy --config proxy.yaml --check"


def name_unknown(view: View) -> Iterator[Found]:
    """No rule names it, and a name that is spelt almost like it exists."""
    if view.near is None or view.near_ends:
        return
    known = [each for each in view.near.known if each != view.facts.asked]
    close = get_close_matches(view.facts.asked, known, n=1, cutoff=0.75)
    if not close:
        return
    yield f"No rule names {view.facts.asked}; did you mean {close[0]}?", f"gdp explain {shlex.quote(close[0])}"


def not_imported(view: View) -> Iterator[Found]:
    """No rule of the near proxy names it."""
    if view.near is None or view.near_ends:
        return
    name = shlex.quote(view.facts.asked)
    far = next((each for proxy in view.far_proxies for each in proxy.flows if each.side == "import"), None)
    if far is not None:
        yield f"No rule of the proxy here exposes {name}, which another proxy imports.", f"gdp expose {name} --help"
    yield f"No rule of the proxy here names {name}, so it stays local.", f"gdp import {name} --help"


def type_support_missing(view: View) -> Iterator[Found]:
    """A machine does not know the type."""
    for end in view.ends:
        if end.flow.problem == "unknown-type" or (end.flow.faults.get("unknown-type") and not end.flow.received):
            package = end.flow.type_name.partition("/")[0] or "PACKAGE"
            text = (
                f"ROS does not know the type {end.flow.type_name} {end.place}: its package is not installed or sourced."
            )
            yield text, f"ros2 interface show {end.flow.type_name or package}"


def local_type_differs(view: View) -> Iterator[Found]:
    """Local nodes use the name with another type than the rule's, or the far definition differs."""
    for end in view.ends:
        flow = end.flow
        if flow.other_types and not flow.nodes:
            text = f"Nodes {end.place} use {flow.local} as {flow.other_types[0]}; the rule says {flow.type_name}."
            yield text, f"ros2 topic info -v {flow.local}"
        if "other-type" in flow.details and not flow.received:
            text = f"The types differ {end.place}: {flow.details['other-type']}."
            yield text, f"ros2 interface show {flow.type_name}"


def graph_away(view: View) -> Iterator[Found]:
    """A ROS graph cannot be had."""
    for end in view.ends:
        if end.flow.problem == "no-graph":
            yield f"The ROS graph {end.place} cannot be had: {end.flow.detail}.", _CHECK


def rival_proxy(view: View) -> Iterator[Found]:
    """Another proxy of the same graph carries the name."""
    for end in view.ends:
        if end.flow.problem == "other-bridge":
            text = (
                f"Another proxy carries {end.flow.local} in the same ROS graph, so the one {end.place} leaves it alone"
            )
            yield f"{text}: {end.flow.detail}.", "ros2 node list"


def ros_domain_differs(view: View) -> Iterator[Found]:
    """ROS nodes of this host are in another ROS domain, and none is in the proxy's."""
    wanted, end = view.facts.graph_domain, _deserted(view)
    if wanted is None or end is None:
        return
    here = [each for each in view.facts.processes if not each.is_apart]
    others = [each for each in here if each.domain != wanted]
    if not others or len(others) < len(here):
        return
    text = (
        f"{others[0].command} (process {others[0].pid}) is in ROS domain {others[0].domain}; the proxy is in {wanted}."
    )
    yield text, f"export ROS_DOMAIN_ID={wanted}"


def shared_memory_only(view: View) -> Iterator[Found]:
    """A ROS node of this host speaks shared memory only, which the proxy does not hear."""
    if _deserted(view) is None:
        return
    for each in view.facts.processes:
        if each.transports.upper().startswith("SHM") and not each.is_apart:
            text = f"{each.command} (process {each.pid}) offers shared memory only, and the proxy does not hear it."
            yield text, "export FASTDDS_BUILTIN_TRANSPORTS=UDPv4"


def no_reader_here(view: View) -> Iterator[Found]:
    """No local node reads an imported topic."""
    for end in view.importers:
        flow = end.flow
        if flow.kind == "topic" and not flow.nodes and flow.is_carried and end.proxy.entities is not None:
            text = f"No node {end.place} subscribes to {flow.local}, so the proxy does not fetch it."
            yield text, f"ros2 topic echo {flow.local}"


def no_publisher(view: View) -> Iterator[Found]:
    """No local node publishes an exposed topic."""
    for end in view.exporters:
        if end.flow.kind == "topic" and not end.flow.nodes and end.proxy.entities is not None:
            yield f"No node {end.place} publishes {end.flow.local}.", f"ros2 topic info -v {end.flow.local}"
    withdrew = [each for rib in view.facts.ribs for each in rib.gone if each.how == "withdrew"]
    if withdrew and not view.advertisers and not view.is_service:
        text = f"Its last publisher left: proxy {short(withdrew[-1].advertiser)} withdrew the name."
        yield text, f"ros2 topic info -v {view.facts.asked}"


def no_server(view: View) -> Iterator[Found]:
    """No node serves a service."""
    for end in view.exporters:
        if end.flow.kind != "topic" and not end.flow.nodes:
            yield f"No node {end.place} serves {end.flow.local}.", f"ros2 service type {end.flow.local}"
    if view.is_service and not view.exporters and not view.advertisers and view.facts.ribs:
        yield f"No machine serves {view.facts.asked} now.", f"ros2 service type {view.facts.asked}"


def replicas_silent(view: View) -> Iterator[Found]:
    """Servers are known, and none answers any more."""
    for end in view.importers:
        flow = end.flow
        if flow.kind != "topic" and not flow.connected and (flow.silent or flow.writers):
            count = max(flow.silent, flow.writers)
            which = f"All {count} known servers" if count > 1 else "The server"
            text = f"{which} of {flow.local} stay silent"
            yield f"{text}: they stopped, or the path to them loses everything.", f"gdp ping {flow.local}"


def type_differs(view: View) -> Iterator[Found]:
    """The far side has the same ROS name with another type."""
    return _namesake(view, "type_name", "type")


def owner_differs(view: View) -> Iterator[Found]:
    """The far side has the same ROS name of another owner."""
    for end in _namesakes(view):
        ours = view.near_ends[0].flow
        if end.flow.owner != ours.owner:
            text = (
                f"The rules name different owners for {ours.local}"
                f" ({ours.owner[:6]} here, {end.flow.owner[:6]} {end.place})"
            )
            yield f"{text}, so their 256-bit names differ.", "gdp name --help"


def metadata_differs(view: View) -> Iterator[Found]:
    """The far side has the same ROS name with other metadata."""
    for end in _namesakes(view):
        ours = view.near_ends[0].flow
        if end.flow.digest != ours.digest:
            text = f"The metadata or salt of {ours.local} differ here and {end.place}, so their 256-bit names differ."
            yield text, _CHECK


def not_exposed(view: View) -> Iterator[Found]:
    """No far proxy that could be asked has a rule that exposes it."""
    if not view.importers or view.exporters or view.advertisers:
        return
    if view.far_proxies and not any(each.flow.side == "expose" for each in view.namesakes):
        whose = short(view.far_proxies[0].name)
        text = f"No rule of proxy {whose} exposes {view.facts.asked}."
        yield text, f"gdp expose {shlex.quote(view.facts.asked)} --help"


def no_advertiser(view: View) -> Iterator[Found]:
    """RIB and switches know no advertiser, and no far proxy could be asked."""
    knows = view.facts.ribs or any(each.is_negative for each in view.facts.switches)
    if view.importers and not view.exporters and not view.advertisers and knows:
        text = (
            "No proxy advertises this name: it is not exposed, nothing publishes it, or type, metadata or owner differ."
        )
        yield text, _CHECK


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


def _namesake(view: View, field: str, word: str) -> Iterator[Found]:
    for end in _namesakes(view):
        ours, theirs = getattr(view.near_ends[0].flow, field), getattr(end.flow, field)
        if ours and theirs and ours != theirs:
            text = f"The {word} differs: {ours} here, {theirs} {end.place}, so their 256-bit names differ."
            yield text, _CHECK


RULES: Final[dict[Cause, Rule]] = {
    Cause.NAME_UNKNOWN: name_unknown,
    Cause.NOT_IMPORTED: not_imported,
    Cause.TYPE_SUPPORT_MISSING: type_support_missing,
    Cause.LOCAL_TYPE_DIFFERS: local_type_differs,
    Cause.GRAPH_AWAY: graph_away,
    Cause.RIVAL_PROXY: rival_proxy,
    Cause.TYPE_DIFFERS: type_differs,
    Cause.OWNER_DIFFERS: owner_differs,
    Cause.METADATA_DIFFERS: metadata_differs,
    Cause.SHARED_MEMORY_ONLY: shared_memory_only,
    Cause.ROS_DOMAIN_DIFFERS: ros_domain_differs,
    Cause.NO_READER_HERE: no_reader_here,
    Cause.NO_PUBLISHER: no_publisher,
    Cause.NO_SERVER: no_server,
    Cause.NOT_EXPOSED: not_exposed,
    Cause.NO_ADVERTISER: no_advertiser,
    Cause.REPLICAS_SILENT: replicas_silent,
}
