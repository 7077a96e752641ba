"""``gdp up`` with one configuration file: one log, programs that come back, an end in order, and suggested rules."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from typing import Final

import pytest

from lab.machine import GDP, LabMachine
from lab.namespaces import Space
from lab.process import LabProcess

pytestmark = pytest.mark.netns

PATIENCE_S: Final = 40.0
PROXY: Final = (
    "identity: proxy\ndomain: {root: proxy/root.crt}\ndelegations: proxy/delegations\niface: proxy0\n"
    "import:\n  - {name: /camera/image, type: sensor_msgs/msg/Image, owner: owner.pub}\n"
)
TALKER: Final = """\
import rclpy
from std_msgs.msg import String
from std_srvs.srv import SetBool
rclpy.init()
node = rclpy.create_node("talker")
publisher = node.create_publisher(String, "/chatter", 10)
node.create_service(SetBool, "/enable", lambda request, response: response)
node.create_timer(0.1, lambda: publisher.publish(String(data="x" * 1000)))
print("talks", flush=True)
rclpy.spin(node)
"""


@pytest.fixture
def lab(machine: LabMachine, space: Space) -> LabMachine:
    """Machine with the files of a robot, in a folder of that name."""
    space.ip("link", "add", "cable", "type", "veth", "peer", "far")
    for device in ("cable", "lo"):
        space.ip("link", "set", device, "up")
    machine.gdp("lab", "robot", "--iface", "cable")
    for each in ("switch.yaml", "rib.yaml"):
        (machine.folder / "robot" / each).unlink()
    (machine.folder / "robot/machine.yaml").write_text("switch: {ports: [{iface: cable}]}\nrib:\nproxy: proxy.yaml\n")
    return machine


@pytest.fixture
def up(lab: LabMachine) -> LabProcess:
    """``gdp up`` with one file."""
    (lab.folder / "robot/proxy.yaml").write_text(PROXY)
    lab.output(sys.executable, "-m", "proxy.cli.delegate", "--owner", "owner", "robot/proxy.yaml")
    return lab.launch([*GDP, "up", "robot/machine.yaml"], "up")


def test_one_file_starts_switch_rib_and_proxy_and_ctrl_c_ends_them_in_order(up: LabProcess) -> None:
    up.until_logged(r"^switch \| switch .* is up")
    up.until_logged(r"^rib    \| RIB .* is up")
    up.until_logged(r"^proxy  \| proxy .* is attached")
    up.finish()
    assert up.code == 0
    ended = [line.split()[0] for line in up.logged.splitlines() if "stopping signal=2" in line]
    assert ended == ["proxy", "rib", "switch"]
    assert subprocess.run(["ip", "link", "show", "rib0"], capture_output=True, check=False).returncode, up.logged
    assert "failed" not in up.logged


def test_a_program_that_ends_comes_back_and_the_exit_code_names_the_failure(up: LabProcess) -> None:
    line = up.until_logged(r"program started program=rib pid=\d+")
    up.until_logged(r"^rib    \| RIB .* is up")
    os.kill(int(line.rpartition("=")[2]), signal.SIGKILL)
    up.until_logged(r"program ended program=rib code=-9 pause_s=0\.2")
    up.until_logged(r"^rib    \| RIB .* is up", times=2)
    up.finish()
    assert up.code == 1
    assert up.logged.splitlines()[-1] == "error: failed: rib; the log has their last words"


def test_a_wrong_configuration_starts_nothing(lab: LabMachine) -> None:
    (lab.folder / "robot/proxy.yaml").write_text(PROXY)
    (lab.folder / "robot/machine.yaml").write_text("switch: {ports: [{iface: cable}], atach: [x]}\nproxy: proxy.yaml\n")
    done = lab.run(*GDP, "up", "robot")
    assert done.returncode == 2
    assert "machine.yaml:1:35: atach: unknown key" in done.stderr
    assert "program started" not in done.stderr


def test_the_first_start_suggests_rules_from_the_live_graph(lab: LabMachine, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    for name, value in {"ROS_DOMAIN_ID": "173", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}.items():
        monkeypatch.setenv(name, value)
    talker = lab.launch([sys.executable, "-c", TALKER])
    assert talker.read_line(PATIENCE_S) == b"talks"
    begun_s = time.monotonic()
    lab.gdp("up", "robot", "--suggest")
    assert time.monotonic() - begun_s < PATIENCE_S
    talker.finish()
    text = (lab.folder / "robot/proxy.yaml").read_text()
    assert "#   - {name: /chatter, type: std_msgs/msg/String, owner: owner.pub}" in text
    assert "#   - {name: /enable, type: std_srvs/srv/SetBool, kind: service, owner: owner.pub}" in text
    assert re.search(r"#   # [\d.]+ Hz, [\d.]+ (bytes|KiB) each; from /talker", text)
    assert "describe_parameters" not in text
    checked = lab.output(sys.executable, "-m", "proxy.cli.proxy", "--config", "robot/proxy.yaml", "--check", "--json")
    assert json.loads(checked.splitlines()[-1])["event"] == "checked"
    active = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert not any("chatter" in line for line in active)
