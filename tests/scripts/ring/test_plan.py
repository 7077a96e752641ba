"""Files of a ring, which its commands accept."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from gdp.config.config import RibConfig, SwitchConfig
from gdp.stores.keyring import load_delegations, load_identity
from gdp.trust.right import Right
from lab.credentials import OverlayCredentials
from lab.topology import ring5
from proxy.config.config import ProxyConfig
from proxy.serial.channel import Channel
from ring.live_plan import AUTHOR
from ring.run import topics_of

RING = ring5()
ROBOT, SERVER = RING.attached("proxy")
CHANNELS = (
    Channel("/imu", "sensor_msgs/msg/Imu", 2),
    Channel("/map", "nav_msgs/msg/OccupancyGrid", 2, latched=True),
)


@pytest.fixture
def credentials(tmp_path: Path) -> OverlayCredentials:
    return OverlayCredentials(RING, tmp_path)


def test_every_switch_gets_a_port_a_link_and_a_device_for_each_attachment(credentials: OverlayCredentials) -> None:
    configs = {node: SwitchConfig.load(credentials.switch(node, "raw")) for node in RING.nodes}
    assert {(port.iface, port.cost) for port in configs["nuc1"].ports} == {("nuc2", 10), ("nuc5", 100)}
    assert {node: config.attach for node, config in configs.items()} == {
        "nuc1": ("robot",),
        "nuc2": ("rib",),
        "nuc3": ("rib",),
        "nuc4": ("rib",),
        "nuc5": ("server",),
    }


def test_the_ribs_of_the_edge_domains_know_the_one_above(credentials: OverlayCredentials, tmp_path: Path) -> None:
    uppers = {at.switch: RibConfig.load(credentials.rib(at)).upper for at in RING.attached("rib")}
    assert uppers["nuc3"] == ()
    assert uppers["nuc2"] == uppers["nuc4"] == (load_identity(tmp_path / "nodes" / "rib-nuc3", time.time()).name,)


def test_both_ends_know_a_topic_by_one_name_and_each_may_do_its_part(
    credentials: OverlayCredentials, tmp_path: Path
) -> None:
    topics, recorded = topics_of(CHANNELS, "cbor"), {"path": str(tmp_path / "got.mcap"), "format": "mcap"}
    sender = ProxyConfig.load(credentials.proxy(ROBOT, {"expose": topics}))
    receiver = ProxyConfig.load(credentials.proxy(SERVER, {"import": topics}, record=recorded))
    names = [rule.overlay_name for rule in sender.expose]
    assert names == [rule.overlay_name for rule in receiver.imports]
    assert [rule.latched for rule in sender.expose] == [False, True]
    given = {Right.PUBLISH: load_delegations(sender.delegations), Right.READ: load_delegations(receiver.delegations)}
    for right, delegations in given.items():
        assert {each.name for each in delegations} == set(names)
        assert {each.rights for each in delegations} == {frozenset({right})}


def test_metrics_are_served_only_when_asked_for(credentials: OverlayCredentials, tmp_path: Path) -> None:
    assert SwitchConfig.load(credentials.switch("nuc1", "raw")).metrics is None
    (tmp_path / "more").mkdir()
    config = SwitchConfig.load(OverlayCredentials(RING, tmp_path / "more", metrics=True).switch("nuc1", "raw"))
    assert config.metrics is not None


def test_a_topic_of_several_publishers_is_one_topic() -> None:
    tf = Channel("/tf", "tf2_msgs/msg/TFMessage", 1, callerid="/a")
    other = Channel("/tf", "tf2_msgs/msg/TFMessage", 1, callerid="/b", latched=True)
    (carried,) = topics_of([tf, other, tf], "json")
    assert (carried.name, carried.type_name, carried.author) == ("/tf", "tf2_msgs/msg/TFMessage", AUTHOR)
    assert carried.options["latched"] is True
