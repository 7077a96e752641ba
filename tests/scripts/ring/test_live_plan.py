"""Parts of a live run, and the files that its proxies accept."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.stores.keyring import load_delegations
from gdp.trust.right import Right
from lab.credentials import OverlayCredentials
from lab.topology import ring5
from proxy.config.config import ProxyConfig
from proxy.config.rule import DOMAIN_MAX
from ring.live_plan import Graph, carried_in, graphs_of, messages_in, paces
from ring.nodes.content import TALKS
from ring.options import Live

RING = ring5()
ROBOT, SERVER = RING.attached("proxy")


@pytest.mark.parametrize(("live", "versions"), [("ros2", (2, 2)), ("ros1", (1, 1)), ("mixed", (1, 2))])
def test_each_kind_of_live_run_has_its_graphs(live: Live, versions: tuple[int, int]) -> None:
    robot, server = graphs_of(live, "ab12cd")
    assert (robot.ros, server.ros) == versions


@pytest.mark.parametrize("run", ["000000", "ffffff", "c6da61"])
def test_the_domain_of_a_run_is_one_whose_ports_no_other_domain_uses(run: str) -> None:
    domains = [graph.domain for graph in graphs_of("ros2", run)]
    assert len(set(domains)) == 2
    assert all(0 < domain <= DOMAIN_MAX and 7_400 + 250 * (domain + 1) < 32_768 for domain in domains)


def test_every_talker_says_at_least_something() -> None:
    assert {messages_in(0.01, talk.hz) for talk in TALKS} == {1}
    assert messages_in(10.0, 15.0) == 150


def test_only_the_camera_follows_the_pace_that_was_asked_for() -> None:
    assert paces(5.0) == {talk.node: talk.hz for talk in TALKS} | {"camera": 5.0}


@pytest.mark.parametrize("ros", [1, 2])
def test_both_proxies_know_all_by_one_name_and_each_may_do_its_part(ros: int, tmp_path: Path) -> None:
    graph = Graph(1 if ros == 1 else 2, 7)
    carried, credentials = carried_in("json"), OverlayCredentials(RING, tmp_path)
    robot = ProxyConfig.load(credentials.proxy(ROBOT, {"expose": carried}, ros=graph.to_yaml()))
    server = ProxyConfig.load(credentials.proxy(SERVER, {"import": carried}, ros=graph.to_yaml()))
    assert [end.ros for end in robot.ros] == [ros]
    names = [rule.overlay_name for rule in robot.expose]
    assert names == [rule.overlay_name for rule in server.imports]
    assert names == [each.metadata.name(robot.expose[0].owner.compressed) for each in carried]
    topic_rights, service_rights = (Right.PUBLISH, Right.READ), (Right.SERVE, Right.CALL)
    for config, at in ((robot, 0), (server, 1)):
        rights = {each.name: each.rights for each in load_delegations(config.delegations)}
        assert [rights[name] for name in names] == [
            frozenset({(service_rights if each.kind == "service" else topic_rights)[at]}) for each in carried
        ]
