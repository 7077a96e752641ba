"""``gdp up`` with one configuration file: one log, programs that come back, an end in order, and suggested rules."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from netns_tests.spaces import Space

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


class Running:
    """``gdp up`` in a process of its own; its log can be awaited."""

    def __init__(self, *words: str, cwd: Path) -> None:
        self.lines: list[str] = []
        self._more = threading.Condition()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "gdp.cli.gdp", "up", *words], cwd=cwd, stderr=subprocess.PIPE, start_new_session=True
        )
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def wait_for(self, pattern: str, count: int = 1) -> str:
        """Return the line that matches for the ``count``-th time."""
        found: list[str] = []

        def enough() -> bool:
            found[:] = [line for line in self.lines if re.search(pattern, line)]
            return len(found) >= count or not self._reader.is_alive()

        with self._more:
            self._more.wait_for(enough, PATIENCE_S)
        assert len(found) >= count, "\n".join([f"no {pattern!r} in", *self.lines])
        return found[count - 1]

    def end(self) -> int:
        """Press Ctrl-C and return the exit code."""
        self.process.send_signal(signal.SIGINT)
        code = self.process.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        return code

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            with self._more:
                self.lines.append(line.decode().rstrip())
                self._more.notify_all()
        self.process.stderr.close()
        with self._more:
            self._more.notify_all()


@pytest.fixture
def lab(tmp_path: Path, space: Space) -> Path:
    subprocess.run(["ip", "link", "add", "cable", "type", "veth", "peer", "far"], check=True)
    subprocess.run(["ip", "link", "set", "cable", "up"], check=True)
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    run("gdp.cli.gdp", "lab", "robot", "--iface", "cable", cwd=tmp_path)
    for each in ("switch.yaml", "rib.yaml"):
        (tmp_path / "robot" / each).unlink()
    (tmp_path / "robot/machine.yaml").write_text("switch: {ports: [{iface: cable}]}\nrib:\nproxy: proxy.yaml\n")
    return tmp_path


@pytest.fixture
def up(lab: Path) -> Iterator[Running]:
    (lab / "robot/proxy.yaml").write_text(PROXY)
    run("proxy.cli.delegate", "--owner", "owner", "robot/proxy.yaml", cwd=lab)
    running = Running("robot/machine.yaml", cwd=lab)
    yield running
    if running.process.poll() is None:
        running.end()


def run(*words: str, cwd: Path) -> None:
    subprocess.run([sys.executable, "-m", *words], cwd=cwd, check=True, capture_output=True)


def test_one_file_starts_switch_rib_and_proxy_and_ctrl_c_ends_them_in_order(up: Running) -> None:
    up.wait_for(r"^switch \| switch .* is up")
    up.wait_for(r"^rib    \| RIB .* is up")
    up.wait_for(r"^proxy  \| proxy .* is attached")
    assert up.end() == 0
    ended = [line.split()[0] for line in up.lines if "stopping signal=2" in line]
    assert ended == ["proxy", "rib", "switch"]
    assert subprocess.run(["ip", "link", "show", "rib0"], capture_output=True, check=False).returncode != 0, "\n".join(
        up.lines
    )
    assert not any("failed" in line for line in up.lines)


def test_a_program_that_ends_comes_back_and_the_exit_code_names_the_failure(up: Running) -> None:
    line = up.wait_for(r"program started program=rib pid=\d+")
    up.wait_for(r"^rib    \| RIB .* is up")
    os.kill(int(line.rpartition("=")[2]), signal.SIGKILL)
    up.wait_for(r"program ended program=rib code=-9 pause_s=0\.2")
    up.wait_for(r"^rib    \| RIB .* is up", count=2)
    assert up.end() == 1
    assert up.lines[-1] == "error: failed: rib; the log has their last words"


def test_a_wrong_configuration_starts_nothing(lab: Path) -> None:
    (lab / "robot/proxy.yaml").write_text(PROXY)
    (lab / "robot/machine.yaml").write_text("switch: {ports: [{iface: cable}], atach: [x]}\nproxy: proxy.yaml\n")
    words = [sys.executable, "-m", "gdp.cli.gdp", "up", "robot"]
    done = subprocess.run(words, cwd=lab, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "machine.yaml:1:35: atach: unknown key" in done.stderr
    assert "program started" not in done.stderr


def test_the_first_start_suggests_rules_from_the_live_graph(lab: Path) -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    environment = {**os.environ, "ROS_DOMAIN_ID": "173", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    talker = subprocess.Popen([sys.executable, "-c", TALKER], env=environment, stdout=subprocess.PIPE)
    assert talker.stdout is not None
    try:
        assert talker.stdout.readline() == b"talks\n"
        words = [sys.executable, "-m", "gdp.cli.gdp", "up", "robot", "--suggest"]
        begun_s = time.monotonic()
        subprocess.run(words, cwd=lab, env=environment, check=True, capture_output=True)
        assert time.monotonic() - begun_s < PATIENCE_S
    finally:
        talker.send_signal(signal.SIGINT)
        talker.wait(PATIENCE_S)
        talker.stdout.close()
    text = (lab / "robot/proxy.yaml").read_text()
    assert "#   - {name: /chatter, type: std_msgs/msg/String, owner: owner.pub}" in text
    assert "#   - {name: /enable, type: std_srvs/srv/SetBool, kind: service, owner: owner.pub}" in text
    assert re.search(r"#   # [\d.]+ Hz, [\d.]+ (bytes|KiB) each; from /talker", text)
    assert "describe_parameters" not in text
    checked = subprocess.run(
        [sys.executable, "-m", "proxy.cli.proxy", "--config", "robot/proxy.yaml", "--check", "--json"],
        cwd=lab,
        env=environment,
        check=True,
        capture_output=True,
    )
    assert json.loads(checked.stdout.splitlines()[-1])["event"] == "checked"
    active = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert not any("chatter" in line for line in active)
