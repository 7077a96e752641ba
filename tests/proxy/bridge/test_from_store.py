"""`history: from-store`: a local reader that comes late gets from a holder what the publisher's memory has no more."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from gdp.nodes.delegation_store import DelegationStore
from gdp.session.keeping import CapsuleKeeper
from gdp.stores.capsule_store import stored
from gdp.trust.right import Right
from lab.inline import Inline
from proxy.bridge.exposed_topic import ExposedTopic
from proxy.bridge.keeping import TopicKeeper
from proxy.config.keep import Keep
from proxy.node.node import ProxyNode
from tests.journeys.capsules import Holder
from tests.proxy.bridge import known
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Granted, Machine, Sites
from tests.proxy.rule_files import proxy, rules

COUNT = 60


def keeper_of(sites: Sites, machine: Machine, folder: Path) -> TopicKeeper:
    """Give a machine a keeper, with a delegation to call the holder."""
    identity = next(each for each in sites.world.identities.values() if each.name == machine.member.name)
    names = ("store", "gone")
    services = [sites.world.topic(name, machine.member, [Right.CALL], kind="service") for name in names]
    held: DelegationStore = Granted(folder, services)
    keeper = TopicKeeper(machine.member, identity, folder, held)
    keeper.capsules = CapsuleKeeper(machine.member, identity, folder, start=7, pool=Inline())
    machine.context = machine.bridge._context = replace(machine.context, keeper=keeper)
    return keeper


@pytest.mark.parametrize("history", ["from-store", "{store: [gone, store]}"])
def test_a_late_reader_gets_the_past_from_a_holder_then_what_is_live(
    tmp_path: Path, history: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    sites = Sites(tmp_path)
    sites.world.add_member("nuc3/holder", "nuc3")
    robot = sites.add(ROBOT, expose=[f"name: /chatter, type: {known.STRING}, reliable: true, latched: false"])
    server = sites.add(SERVER, imports=[f"name: /chatter, type: {known.STRING}, history: {history}"])
    holder = Holder(sites.world, tmp_path / "holder", "nuc3/holder", service="store")
    keeper = keeper_of(sites, robot, tmp_path / "robot")
    keeper_of(sites, server, tmp_path / "server")
    sites.every(0.05, 600, lambda _: holder.work())
    talker = robot.graph.publish("/talker", "/chatter", known.STRING)
    assert sites.run(5, lambda: any(isinstance(flow, ExposedTopic) for _, flow in robot.bridge.flows))
    (flow,) = [flow for _, flow in robot.bridge.flows if isinstance(flow, ExposedTopic)]
    assert flow.publisher is not None
    unix_s = sites.world.network.now.unix_s
    assert keeper.keep("/chatter", flow._topic, flow.publisher, Keep(to=("store",)), unix_s) == ""
    for number in range(COUNT):
        sites.world.network.call(0.1 * number, partial(talker.publish, known.string(str(number))))
    sites.run(4)
    ear = Ear(server.graph, "/chatter")
    assert sites.run(20, lambda: len(ear.texts) >= COUNT)
    assert ear.texts == [str(number) for number in range(COUNT)]
    assert server.faults == {}
    assert "past of /chatter is read at store: " in caplog.text


def test_the_first_rule_that_keeps_may_come_with_a_reload(tmp_path: Path) -> None:
    sites = Sites(tmp_path)
    sites.world.add_member("nuc3/holder", "nuc3")
    chatter = f"name: /chatter, type: {known.STRING}"
    robot = sites.add(ROBOT, expose=[chatter])
    holder = Holder(sites.world, tmp_path / "holder", "nuc3/holder", service="store")
    sites.every(0.05, 600, lambda _: holder.work())
    node = ProxyNode.__new__(ProxyNode)  # without files and devices
    node.member = robot.member
    node.identity = next(each for each in sites.world.identities.values() if each.name == robot.member.name)
    graph = "state: .\nros: [{endpoint: ros2, domain: 0}]\nexpose:\n"
    keeper = node.open_keeper(proxy(tmp_path, graph + rules(chatter)), robot.bridge.held)
    keeper.capsules._pool = Inline()
    robot.context = robot.bridge._context = replace(robot.context, keeper=keeper)
    talker = robot.graph.publish("/talker", "/chatter", known.STRING)
    sites.run(2)
    talker.publish(known.string("before"))
    sites.run(2)
    assert (list(stored(tmp_path / "holder")), keeper.get_timer()) == ([], None)

    settings = proxy(tmp_path, graph + rules(f"{chatter}, keep: {{to: store}}"))
    service = sites.world.topic("store", robot.member, [Right.CALL], kind="service")
    robot.bridge.reload(settings, Granted(tmp_path, [*sites.held(robot.member, settings), service]))
    robot.tick_at_s = 0.0
    assert sites.run(5, lambda: bool(keeper.capsules.topics))
    for number in range(COUNT):
        sites.world.network.call(0.1 * number, partial(talker.publish, known.string(str(number))))
    sites.run(0.1 * COUNT)
    (kept,) = keeper.capsules.topics.values()
    assert sites.run(10, lambda: kept.ring.end > COUNT and kept.is_uploaded)
    (held,) = stored(tmp_path / "holder")
    assert (held.name, held.segments.end) == (kept.name, kept.ring.end)
    assert robot.faults == {}
