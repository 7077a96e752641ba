"""Names shared between two live proxies, while another topic flows between them and loses nothing."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from gdp.crypto.certificates import Role
from gdp.management.control_client import ask_node, find_control_socket
from gdp.metadata import Metadata
from gdp.state.control_protocol import Command
from gdp.stores.issue import delegate, install_delegation, make_domain, make_node, make_owner
from gdp.stores.keyring import CARD, DELEGATIONS
from gdp.trust.right import Right
from netns_tests.spaces import Space
from tests.pages import ROOT
from tests.proxy.endpoints.ros2_net import CONFINED, DOMAIN, Peer, needs

needs("std_msgs")

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about rules that change, no lease matters"),
    pytest.mark.skipif(os.geteuid() != 0, reason="only root opens devices"),
]

PATIENCE_S = 30.0
STRING = "std_msgs/msg/String"
CLOSES_S = 1.0
_NODE = "domain: {root: %s/root.crt}\nidentity: %s\n"
_TALKER = """
import time
from std_msgs.msg import String
talks, said = {}, {}
def say(topic):
    said[topic] = 0
    talks[topic] = node.create_publisher(String, topic, 1000)
def tick():
    for topic, out in list(talks.items()):
        if out.get_subscription_count():
            out.publish(String(data=f'{said[topic]} {time.time()}'))
            said[topic] += 1
timer = node.create_timer(0.005, tick)
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
latched = node.create_publisher(
    String, '/robot_description', QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
latched.publish(String(data='a robot'))
clock = node.create_publisher(String, '/clock', QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
"""
_LISTENER = """
from std_msgs.msg import String
reads, got = {}, {}
def read(topic):
    got[topic] = []
    reads[topic] = node.create_subscription(String, topic, lambda m: got[topic].append(m.data), 1000)
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile
incompatible = []
def read_latched(topic):
    got[topic] = []
    reads[topic] = node.create_subscription(
        String, topic, lambda m: got[topic].append(m.data),
        QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
        event_callbacks=SubscriptionEventCallbacks(incompatible_qos=lambda event: incompatible.append(topic)))
def offered(topic):
    return [
        (i.qos_profile.reliability.name, i.qos_profile.durability.name)
        for i in node.get_publishers_info_by_topic(topic)
    ]
"""


class Site:
    """A switch, a RIB and two proxies, each with a graph of its own, and a real node in each graph."""

    def __init__(self, home: Path, stack: ExitStack) -> None:
        self.home = home
        self._stack = stack
        make_domain(home / "lab", "lab")
        make_owner(home / "owner")
        for name, role in (("switch", Role.SWITCH), ("rib", Role.RIB)):
            make_node(home / "robot" / name, role, "robot", home / "lab")
        (home / "robot" / "revocations").mkdir()
        attach = "attach: [rib0, robot0, server0]\nrevocations: revocations\n"
        self._write("robot/switch.yaml", _NODE % ("switch", "switch") + attach)
        self._write("robot/rib.yaml", _NODE % ("rib", "rib") + "iface: rib0\n")
        self._start("gdp.cli.switch", "robot/switch", "--data-plane", "raw")
        self._start("gdp.cli.rib", "robot/rib", "--await-iface", "30")
        for side, label in enumerate(("robot", "server")):
            self._add_proxy(label, DOMAIN + side, Right.READ if side else Right.PUBLISH)
        self.talker, self.listener = (
            Peer(f"node_{label}", ["env", f"ROS_DOMAIN_ID={DOMAIN + side}"]) for side, label in enumerate("ab")
        )
        for peer, text in ((self.talker, _TALKER), (self.listener, _LISTENER)):
            stack.callback(peer.end)
            peer.tell("!" + text)

    def gdp(self, command: str, host: str, *words: str) -> dict[str, Any]:
        """Run a command of ``gdp`` on one machine; return its JSON output."""
        argv = [
            sys.executable,
            "-m",
            "gdp.cli.gdp",
            command,
            *words,
            "--directory",
            host,
            "--exchange",
            "common",
            "--json",
        ]
        done = subprocess.run(
            argv,
            cwd=self.home,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        result: dict[str, Any] = json.loads(done.stdout)
        return result

    def heard(self, topic: str) -> list[tuple[int, float]]:
        """Return number and second of sending of the messages that came."""
        texts = self.listener.tell(f"got['{topic}']")
        assert isinstance(texts, list)
        return [(int(number), float(at_s)) for number, at_s in (text.split() for text in texts)]

    def until_heard(self, topic: str, more_than: int = 0) -> None:
        """Wait until more messages of a topic came than a number."""
        end_s = time.monotonic() + PATIENCE_S
        while len(self.heard(topic)) <= more_than:
            assert time.monotonic() < end_s, f"{topic}: nothing came"
            time.sleep(0.05)

    def _add_proxy(self, label: str, domain: int, right: Right) -> None:
        proxy = self.home / label / "proxy"
        make_node(proxy, Role.PROXY, label, self.home / "lab")
        (proxy / DELEGATIONS).mkdir()
        metadata = Metadata({"kind": "topic", "name": "/steady", "type": STRING})
        install_delegation(proxy, delegate(self.home / "owner", proxy / CARD, metadata, [right]))
        side = "expose" if right is Right.PUBLISH else "import"
        self._write(
            f"{label}/proxy.yaml",
            _NODE % ("proxy", "proxy")
            + f"iface: {label}0\ndelegations: proxy/{DELEGATIONS}\n"
            + f"ros: {{endpoint: ros2, domain: {domain}, exclusive: true}}\n"
            + f"{side}: [{{name: /steady, type: {STRING}, owner: ../owner/owner.pub}}]\n",
        )
        self._start("proxy.cli.proxy", f"{label}/proxy", "--await-iface", "30")

    def _write(self, name: str, text: str) -> None:
        path = self.home / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)

    def _start(self, module: str, name: str, *more: str) -> None:
        path = (self.home / name).with_suffix(".yaml")
        log = path.with_suffix(".log")
        with log.open("wb") as errors:
            process = subprocess.Popen(
                [sys.executable, "-m", module, "--config", str(path), "--json", *more],
                stdout=errors,
                stderr=errors,
                env={**os.environ, **CONFINED, "PYTHONPATH": str(ROOT)},
            )
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        end_s = time.monotonic() + PATIENCE_S
        while '"ready"' not in log.read_text():
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < end_s, log.read_text()
            time.sleep(0.05)


@pytest.fixture
def site(space: Space, tmp_path: Path) -> Iterator[Site]:
    space.ip("set", "lo", "up")
    with ExitStack() as stack:
        yield Site(tmp_path, stack)


def test_topics_are_shared_and_taken_back_while_another_flows_without_a_loss(site: Site) -> None:
    for topic in ("/steady", "/camera/left/image"):
        site.listener.tell(f"!read('{topic}')")
    site.talker.tell("!say('/steady')")
    site.until_heard("/steady")
    assert site.gdp("import", "server", "/camera/**", "--from", "robot")["is_running"] is True
    assert site.gdp("expose", "robot", "/camera/**", "--to", "server", "--wait", "0")["delegated"] == []
    site.talker.tell("!say('/camera/left/image')")
    end_s = time.monotonic() + PATIENCE_S
    while not (delegated := site.gdp("share", "robot", "--renew")["delegated"]):
        assert time.monotonic() < end_s
    assert [(each["name"], each["node"]) for each in delegated] == [
        ("/camera/left/image", "robot"),
        ("/camera/left/image", "server"),
    ]
    assert site.gdp("share", "server", "--renew")["problems"] == []
    site.until_heard("/camera/left/image", 50)
    assert site.gdp("share", "robot", "/camera/left/image", "--revoke", "server")["problems"] == []
    revoked_s = time.time()
    site.talker.waits_for(f"time.time() > {revoked_s + 2 * CLOSES_S}", True)
    assert max(at_s for _, at_s in site.heard("/camera/left/image")) < revoked_s + CLOSES_S
    site.gdp("import", "server", "/camera/**", "--remove")
    site.gdp("expose", "robot", "/camera/**", "--remove")
    site.until_heard("/steady", len(site.heard("/steady")) + 100)
    numbers = [number for number, _ in site.heard("/steady")]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_the_far_graph_shows_a_publishers_qos_before_any_reader_and_the_first_latched_one_matches(site: Site) -> None:
    for topic, qos in (
        ("/robot_description", ("RELIABLE", "TRANSIENT_LOCAL")),
        ("/clock", ("BEST_EFFORT", "VOLATILE")),
    ):
        assert site.gdp("import", "server", topic, "--from", "robot")["is_running"] is True
        assert site.gdp("expose", "robot", topic, "--to", "server", "--wait", str(PATIENCE_S))["delegated"]
        assert site.gdp("share", "server", "--renew")["problems"] == []
        site.listener.waits_for(f"offered('{topic}')", [list(qos)])
    site.listener.tell("!read_latched('/robot_description')")
    site.listener.waits_for("got['/robot_description']", ["a robot"])
    assert site.listener.tell("incompatible") == []


def test_a_name_that_its_machine_no_longer_exposes_leaves_the_far_graph_and_comes_back(site: Site) -> None:
    def imported() -> set[object]:
        names = ask_node(find_control_socket(site.home / "server" / "proxy"), Command.STATUS, PATIENCE_S).result
        return {each["local"] for each in names["liveliness"] if each["side"] == "import"}  # type: ignore[attr-defined]

    topic, expose = "/clock", ("expose", "robot", "/clock", "--to", "server", "--wait", str(PATIENCE_S))
    assert site.gdp("import", "server", topic)["is_running"] is True
    for _ in range(2):
        assert site.gdp(*expose)["delegated"]
        assert site.gdp("import", "server", "--list")["offers"][0]["state"] == "used"
        site.listener.waits_for(f"offered('{topic}')", [["BEST_EFFORT", "VOLATILE"]])
        assert topic in imported()
        assert site.gdp("expose", "robot", topic, "--remove")["problems"] == []
        assert site.gdp("import", "server", "--list")["offers"][0]["state"] == "withdrawn: robot no longer exposes it"
        site.listener.waits_for(f"offered('{topic}')", [])
        assert topic not in imported()
