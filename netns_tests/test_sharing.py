"""Names shared between two live proxies, while another topic flows between them and loses nothing."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from gdp.crypto.certificates import Role
from gdp.stores.keyring import DELEGATIONS
from gdp.trust.right import Right
from lab.credentials import make_nodes
from lab.machine import LabMachine
from lab.namespaces import Space
from lab.process import until
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
timer = node.create_timer(0.02, tick)
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
latched = node.create_publisher(
    String, '/robot_description', QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
latched.publish(String(data='a robot'))
quick = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
volatile = [node.create_publisher(String, topic, quick) for topic in ('/scan', '/clock')]
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

    def __init__(self, machine: LabMachine, stack: ExitStack) -> None:
        self.machine = machine
        nodes = {"robot/switch": Role.SWITCH, "robot/rib": Role.RIB}
        nodes |= {"robot/proxy": Role.PROXY, "server/proxy": Role.PROXY}
        rights = {"robot/proxy": {"/steady": [Right.PUBLISH]}, "server/proxy": {"/steady": [Right.READ]}}
        make_nodes(machine.folder, nodes, rights, {"/steady": STRING})
        (machine.folder / "robot" / "revocations").mkdir()
        attach = {"attach": ["rib0", "robot0", "server0"], "revocations": "revocations"}
        machine.write("robot/switch", "switch", **attach)
        machine.write("robot/rib", "rib", iface="rib0")
        machine.start("switch", "robot/switch", "--data-plane", "raw")
        machine.start("rib", "robot/rib", "--await-iface", "30")
        for number, (label, side) in enumerate((("robot", "expose"), ("server", "import"))):
            ros = {"endpoint": "ros2", "domain": DOMAIN + number, "exclusive": True}
            rules = {side: [{"name": "/steady", "type": STRING, "owner": "../owner/owner.pub"}]}
            keys = {"iface": f"{label}0", "delegations": f"proxy/{DELEGATIONS}", "ros": ros}
            machine.write(f"{label}/proxy", "proxy", **keys, **rules)
            machine.start("proxy", f"{label}/proxy", "--await-iface", "30")
        self.talker, self.listener = (
            Peer(f"node_{label}", ["env", f"ROS_DOMAIN_ID={DOMAIN + side}"]) for side, label in enumerate("ab")
        )
        for peer, text in ((self.talker, _TALKER), (self.listener, _LISTENER)):
            stack.callback(peer.end)
            peer.tell("!" + text)

    def gdp(self, command: str, host: str, *words: str) -> dict[str, Any]:
        """Run a command of ``gdp`` on one machine; return its JSON output."""
        given = ("--directory", host, "--exchange", "common", "--json")
        result: dict[str, Any] = json.loads(self.machine.gdp(command, *words, *given))
        return result

    def heard(self, topic: str) -> list[tuple[int, float]]:
        """Return number and second of sending of the messages that came."""
        texts = self.listener.tell(f"got['{topic}']")
        assert isinstance(texts, list)
        return [(int(number), float(at_s)) for number, at_s in (text.split() for text in texts)]

    def until_heard(self, topic: str, more_than: int = 0) -> None:
        """Wait until more messages of a topic came than a number."""
        until(lambda: self.listener.tell(f"len(got['{topic}']) > {more_than}"), topic, PATIENCE_S)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    folder = tmp_path_factory.mktemp("site")
    with Space() as space, LabMachine(folder, environment=CONFINED) as machine, ExitStack() as stack:
        space.ip("link", "set", "lo", "up")
        yield Site(machine, stack)


def test_topics_are_shared_and_taken_back_while_another_flows_without_a_loss(site: Site) -> None:
    for topic in ("/steady", "/camera/left/image"):
        site.listener.tell(f"!read('{topic}')")
    site.talker.tell("!say('/steady')")
    site.until_heard("/steady")
    assert site.gdp("import", "server", "/camera/**", "--from", "robot")["is_running"] is True
    assert site.gdp("expose", "robot", "/camera/**", "--to", "server", "--wait", "0")["delegated"] == []
    site.talker.tell("!say('/camera/left/image')")
    delegated = until(lambda: site.gdp("share", "robot", "--renew")["delegated"], "a delegation", PATIENCE_S)
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
    site.talker.tell("!timer.cancel()")


def test_the_far_graph_shows_a_publishers_qos_before_any_reader_and_the_first_latched_one_matches(site: Site) -> None:
    for topic, qos in (
        ("/robot_description", ("RELIABLE", "TRANSIENT_LOCAL")),
        ("/scan", ("BEST_EFFORT", "VOLATILE")),
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
        names = site.machine.status("server/proxy")
        return {each["local"] for each in names["liveliness"] if each["side"] == "import"}

    def state() -> object:
        (offer,) = (each for each in site.gdp("import", "server", "--list")["offers"] if each["name"] == topic)
        return offer["state"]

    topic, expose = "/clock", ("expose", "robot", "/clock", "--to", "server", "--wait", str(PATIENCE_S))
    assert site.gdp("import", "server", topic)["is_running"] is True
    for _ in range(2):
        assert site.gdp(*expose)["delegated"]
        assert state() == "used"
        site.listener.waits_for(f"offered('{topic}')", [["BEST_EFFORT", "VOLATILE"]])
        assert topic in imported()
        assert site.gdp("expose", "robot", topic, "--remove")["problems"] == []
        assert state() == "withdrawn: robot no longer exposes it"
        site.listener.waits_for(f"offered('{topic}')", [])
        assert topic not in imported()
