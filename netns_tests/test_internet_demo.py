"""Demonstration across an internet: nothing is lost while networks change, and nothing stays behind."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys

import pytest

from gdp.host.run_registry import RunRegistry
from tests.proxy.endpoints.ros1_net import need_ros1

pytestmark = [
    pytest.mark.netns,
    pytest.mark.skipif(shutil.which("wireguard-go") is None, reason="needs wireguard-go"),
    pytest.mark.skipif(not os.access("/dev/net/tun", os.R_OK | os.W_OK), reason="needs /dev/net/tun"),
    pytest.mark.skipif(None in map(shutil.which, ("nft", "conntrack")), reason="needs nft and conntrack"),
]

_PATIENCE_S = 240.0


def test_no_image_and_no_call_is_lost_while_addresses_change_nats_forget_and_an_uplink_is_cut() -> None:
    argv = [sys.executable, "-m", "internet_demo", "--calm", "1", "--delay", "0", "--rate", "10", "--json"]
    before = {each.run for each in RunRegistry().all()}
    ended = subprocess.run(argv, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    assert ended.stdout, ended.stderr
    reported = json.loads(ended.stdout)
    assert (reported["lost"], reported["doubled"], ended.returncode) == (0, 0, 0), reported
    assert reported["images"] > 40
    assert len(reported["typed"]) == 6
    assert len(reported["events"]) == 6
    assert all(each.owner.alive or each.run in before for each in RunRegistry().all())


def test_figure_1_a_ros_2_drone_changes_networks_and_no_image_and_no_command_of_a_ros_1_cloud_is_lost() -> None:
    pytest.importorskip("rclpy", reason="needs the extra ros2")
    need_ros1()
    argv = [sys.executable, "-m", "internet_demo", "--figure1", "--calm", "2", "--delay", "0", "--rate", "10", "--json"]
    ended = subprocess.run(argv, capture_output=True, text=True, timeout=_PATIENCE_S, check=False)
    assert ended.stdout, ended.stderr
    reported = json.loads(ended.stdout)
    assert (reported["lost"], reported["doubled"], ended.returncode) == (0, 0, 0), reported
    assert [event["text"] for event in reported["events"]] == [
        f"{topic}: 40 sent, 40 arrived, 0 lost" for topic in ("/images", "/commands")
    ]
    drawn = "\n".join(reported["drawing"])
    assert drawn.index("ROS 2") < drawn.index("enterprise") < drawn.index("university")
    assert "ROS 1" in drawn
    names = re.findall(r"(/\w+) +is ([0-9a-f]{64})", drawn)
    assert len(names) == 4
    assert len(set(names)) == 2  # the names stay while the networks change
