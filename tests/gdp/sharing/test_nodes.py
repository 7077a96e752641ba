"""A node that is shared: a machine that takes it gets what it has, and no more."""

from __future__ import annotations

from contextlib import ExitStack

from gdp.ros_names import NODE_TYPE
from gdp.sharing.state import AcceptedName
from tests.gdp.sharing.machines import PLAN, STRING, Machine, Site, importing

NODE = ("node", "/talker", NODE_TYPE)
HAS = (
    ("expose", "topic", "/chatter", STRING),
    ("expose", "service", "/talker/plan", PLAN),
    ("import", "topic", "/cmd", STRING),
)
OTHER_SIDE = {"expose": "import", "import": "expose"}


def begin(site: Site, robot: Machine, server: Machine) -> None:
    """Expose the node and another name; the server takes the node alone."""
    robot.graph = [NODE, ("topic", "/scan", STRING)]
    robot.brought = [("/talker", side, *thing) for side, *thing in HAS]  # type: ignore[misc]
    server.brought = [("/talker", OTHER_SIDE[side], *thing) for side, *thing in HAS]  # type: ignore[misc]
    robot.sharing.expose(robot.exposing("/scan", "server"), site.now_s)
    robot.sharing.expose(robot.exposing("/talker", "server", kind="node"), site.now_s)
    server.sharing.accept(importing("/talker", "robot"), site.now_s)
    for _ in range(3):
        assert site.upkeep() == []


def test_both_ends_get_the_rights_on_what_a_node_has(site: Site, robot: Machine, server: Machine) -> None:
    begin(site, robot, server)
    assert robot.rights() == {
        "/talker": {"serve"},
        "/chatter": {"publish"},
        "/talker/plan": {"serve"},
        "/cmd": {"read"},
        "/scan": {"publish"},
    }
    assert server.rights() == {
        "/talker": {"call"}, "/chatter": {"read"}, "/talker/plan": {"call"}
    }  # fmt: skip
    assert (server.rules("import"), server.rules("expose")) == ([("/talker", NODE_TYPE)], [])


def test_a_later_recipient_gets_it_too(site: Site, robot: Machine, server: Machine) -> None:
    with ExitStack() as stack:
        begin(site, robot, server)
        laptop = site.add("laptop")
        laptop.brought = server.brought
        laptop.start(stack)
        robot.sharing.expose(robot.exposing("/talker", "laptop", kind="node"), site.now_s)
        laptop.sharing.accept(importing("/talker", "robot"), site.now_s)
        for _ in range(3):
            assert site.upkeep() == []
        assert laptop.rights() == server.rights()


def test_without_the_node_nothing_of_it_is_held(site: Site, robot: Machine, server: Machine) -> None:
    begin(site, robot, server)
    server.sharing.stop_accepting("import", "/talker", site.now_s)
    assert server.held == []


def test_it_ends_where_it_is_no_longer_exposed(site: Site, robot: Machine, server: Machine) -> None:
    begin(site, robot, server)
    robot.sharing.stop_exposing("node", "/talker", site.now_s)
    for _ in range(2):
        assert site.upkeep() == []
    assert server.held == []


def test_what_a_node_subscribes_to_is_accepted_by_name(site: Site, robot: Machine, server: Machine) -> None:
    begin(site, robot, server)
    assert "/cmd" not in server.rights()
    server.sharing.accept(AcceptedName(side="expose", name="/cmd", source="robot"), site.now_s)
    assert server.rights()["/cmd"] == {"publish"}
    assert server.rules("expose") == [("/cmd", STRING)]


def test_of_the_nodes_of_a_pattern_a_machine_may_take_some(site: Site, robot: Machine, server: Machine) -> None:
    robot.graph = [("node", "/*", NODE_TYPE)]  # as the live proxy names the nodes of the rule
    robot.brought = [("/*", side, *thing) for side, *thing in HAS]  # type: ignore[misc]
    server.brought = [("/talker", OTHER_SIDE[side], *thing) for side, *thing in HAS]  # type: ignore[misc]
    robot.sharing.expose(robot.exposing("/*", "server", kind="node"), site.now_s)
    server.sharing.accept(importing("/talker", "robot"), site.now_s)
    for _ in range(3):
        assert site.upkeep() == []
    assert server.rights() == {"/*": {"call"}, "/chatter": {"read"}, "/talker/plan": {"call"}}
    assert server.rules("import") == [("/talker", NODE_TYPE)]
