"""Verbs of ros2cli give the same output on the robot and from afar, with real ROS 2 nodes in two domains."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest

from tests.proxy.bridge.ros2_sites import Ros2Sites, ros2_sites
from tests.proxy.endpoints.ros2_interfaces import Interfaces
from tests.proxy.endpoints.ros2_net import CONFINED, Peer, needs, peer_of

DOMAINS = 200 + os.getpid() % 16, 216 + os.getpid() % 16
EXPOSE = "kind: node, name: '/*', encoding: cdr"
GIVE = "name: /cmd"  # of the station, to what the robot subscribes to
IMPORT = tuple(f"kind: node, name: {name}" for name in ("/talker", "/driver", "/container"))
GRAPH = {  # what a verb prints, by call
    "node list": "node_list(node)",
    "node info": "[node_info(node, each) for each in ('talker', 'driver', 'container')]",
    "topic list, type, find": "topic_list(node)",
    "topic info -v": "[topic_info(node, each) for each in ('/chatter', '/point', '/cmd', '/heard')]",
    "service list, type, find": "service_list(node)",
    "action list, type": "action_list(node)",
    "action info": "action_info(node)",
    "lifecycle nodes": "lifecycle_nodes(node)",
}
PAGE = Path(__file__).parents[3] / "docs/reference/ros2cli.md"
NOT = """
Not the same: GIDs are those of the other graph. Of QoS events [some cross](qos.md).
"""
VERBS = {
    **GRAPH,
    "topic echo": "topic_echo(node)",
    "topic hz, bw": "topic_hz(node)",
    "topic delay": "topic_delay(node)",
    "topic pub": "topic_pub(node)",
    "topic echo of /rosout": "rosout(node)",
    "service call": "service_call(node)",
    "param list": "[param_list(node, '/talker'), param_list(node, '/driver')]",
    "param get": "param_get(node, 'rate', 'label', 'count')",
    "param dump": "param_dump(node)",
    "param describe": "param_describe(node)",
    "param set": "param_set(node)",
    "param load": "param_load(node)",
    "service get_type_description": "type_description(node)",
    "action send_goal": "action_send_goal(node)",
    "bag record": "bag_record(node)",
    "lifecycle list": "lifecycle_list(node)",
    "lifecycle get": "lifecycle_get(node)",
    "lifecycle set": "lifecycle_set(node)",
    "component list": "component_list(node)",
    "component load": "component_load(node)",
    "component unload": "component_unload(node)",
    "tf2 monitor": "tf2_monitor(node)",
    "tf2 echo": "tf2_echo(node)",
}


def test_verbs_give_the_same_output_from_afar(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    needs("geometry_msgs", "std_srvs", "test_msgs", "lifecycle_msgs")
    interfaces = Interfaces(tmp_path / "interfaces")
    interfaces.use(monkeypatch)
    robot, station = DOMAINS

    def peer(name: str, domain: int) -> Peer:
        environment = {**CONFINED, **interfaces.environment, "ROS_DOMAIN_ID": str(domain)}
        started: Peer = stack.enter_context(peer_of(name, environment=environment))
        started.tell("!" + interfaces.load)
        return started

    with ExitStack() as stack:
        nodes, here = peer("talker", robot), peer("_here", robot)
        nodes.tell("!import ros2_robot\nkept.append(ros2_robot.begin(node))")
        here.tell("!from ros2_verbs import *")
        here.waits_for("'/driver' in node_list(node)", wanted=True)
        expected = {verb: here.tell(call) for verb, call in VERBS.items()}
        here.end()
        sites = stack.enter_context(ros2_sites(tmp_path, DOMAINS, [EXPOSE], IMPORT, [GIVE]))
        afar = peer("_afar", station)
        afar.tell(
            "!from ros2_verbs import *\nfrom concurrent.futures import ThreadPoolExecutor\npool = ThreadPoolExecutor(1)"
        )
        for verb, call in GRAPH.items():
            sites.until(partial(gives, afar, call, expected[verb]), f"{verb}: {expected[verb]}")
        found = {verb: ask(sites, afar, call) for verb, call in VERBS.items()}
        assert found == expected
        assert PAGE.read_text(encoding="utf-8").endswith(table(found) + NOT)


def gives(peer: Peer, call: str, expected: object) -> bool:
    """Return whether an expression has a value now."""
    return peer.tell(call) == expected


def table(verbs: Iterable[str]) -> str:
    """Return the table of the page: a row for each command with its verbs."""
    rows: dict[str, list[str]] = {}
    for command, _, verb in (each.partition(" ") for each in verbs):
        rows.setdefault(command, []).append(verb)
    lines = [f"| `{command}` | {', '.join(each)} |" for command, each in rows.items()]
    return "\n".join(["| command | verbs whose output is the same |", "|---|---|", *lines, ""])


def ask(sites: Ros2Sites, peer: Peer, call: str) -> object:
    """Return the value of an expression that waits for what the machines do meanwhile."""
    peer.tell(f"!asked = pool.submit(lambda: {call})")
    sites.until(lambda: peer.tell("asked.done()"), call)
    return peer.tell("asked.result()")
