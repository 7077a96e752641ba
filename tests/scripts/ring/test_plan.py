"""Files of a ring, which its commands accept."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from gdp.config.config import RibConfig, SwitchConfig
from gdp.stores.keyring import load_delegations, load_identity
from gdp.trust.right import Right
from lab.topology import ring5
from proxy.config.config import ProxyConfig
from proxy.serial.channel import Channel
from ring.credentials import OverlayCredentials
from ring.plan import Topic, topics_of

RING = ring5()
ROBOT, SERVER = RING.attached("proxy")
TOPICS = (
    Topic("/imu", "sensor_msgs/msg/Imu", latched=False),
    Topic("/map", "nav_msgs/msg/OccupancyGrid", latched=True),
)


@pytest.fixture
def materials(tmp_path: Path) -> OverlayCredentials:
    return OverlayCredentials(RING, tmp_path, metrics=False)


def test_every_switch_gets_a_port_a_link_and_a_device_for_each_attachment(materials: OverlayCredentials) -> None:
    configs = {node: SwitchConfig.load(materials.switch(node, "raw")) for node in RING.nodes}
    assert {(port.iface, port.cost) for port in configs["nuc1"].ports} == {("nuc2", 10), ("nuc5", 100)}
    assert {node: config.attach for node, config in configs.items()} == {
        "nuc1": ("robot",),
        "nuc2": ("rib",),
        "nuc3": ("rib",),
        "nuc4": ("rib",),
        "nuc5": ("server",),
    }


def test_the_ribs_of_the_edge_domains_know_the_one_above(materials: OverlayCredentials, tmp_path: Path) -> None:
    uppers = {at.switch: RibConfig.load(materials.rib(at)).upper for at in RING.attached("rib")}
    assert uppers["nuc3"] == ()
    assert uppers["nuc2"] == uppers["nuc4"] == (load_identity(tmp_path / "nodes" / "rib-nuc3", time.time()).name,)


def test_both_ends_know_a_topic_by_one_name_and_each_may_do_its_part(
    materials: OverlayCredentials, tmp_path: Path
) -> None:
    sender = ProxyConfig.load(materials.sender(ROBOT, TOPICS, "cbor", 2))
    receiver = ProxyConfig.load(materials.receiver(SERVER, TOPICS, "cbor", 2, tmp_path / "got.mcap"))
    names = [rule.overlay_name for rule in sender.expose]
    assert names == [rule.overlay_name for rule in receiver.imports]
    assert [rule.latched for rule in sender.expose] == [False, True]
    given = {Right.PUBLISH: load_delegations(sender.delegations), Right.READ: load_delegations(receiver.delegations)}
    for right, delegations in given.items():
        assert {each.name for each in delegations} == set(names)
        assert {each.rights for each in delegations} == {frozenset({right})}


def test_metrics_are_served_only_when_asked_for(materials: OverlayCredentials, tmp_path: Path) -> None:
    assert SwitchConfig.load(materials.switch("nuc1", "raw")).metrics is None
    (tmp_path / "more").mkdir()
    config = SwitchConfig.load(OverlayCredentials(RING, tmp_path / "more", metrics=True).switch("nuc1", "raw"))
    assert config.metrics is not None


def test_a_topic_of_several_publishers_is_one_topic() -> None:
    tf = Channel("/tf", "tf2_msgs/msg/TFMessage", 1, callerid="/a")
    other = Channel("/tf", "tf2_msgs/msg/TFMessage", 1, callerid="/b", latched=True)
    assert topics_of([tf, other, tf]) == (Topic("/tf", "tf2_msgs/msg/TFMessage", latched=True),)
