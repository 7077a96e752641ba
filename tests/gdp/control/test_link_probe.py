"""Probes of links: a link that fails alone is left early, and a node or an uplink that is slow has its time."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from gdp.control.endpoints import Endpoint
from gdp.control.fragments import ControlFragmenter
from gdp.control.hello import NodeSettings, Timing
from gdp.control.link_probe import LinkProbe, patience_s
from gdp.control.link_quality import LinkQuality
from gdp.control.neighbour_discovery import HelloProtocol
from gdp.crypto.identity import Identity
from gdp.crypto.statements import parse
from gdp.errors import RemoteError
from gdp.frame.codec import Kind, decode
from gdp.sansio import BROADCAST, ReceivedFrame
from tests.gdp.control.members import POLICY, UNIX_S, Nonces, at, node, statement_of

ROBOT, BORDER, SERVER, OTHER = (node(label) for label in ("robot", "border", "server", "other"))
STEP_S = 0.005
DELAY_S = 0.005
EARLY_S = 0.1
SLOW = Timing(70, 70, 12)  # a loaded node asks for this multiplier: 840 ms

End = tuple[str, int]  # node, port


class Mesh:
    """Nodes that are joined by cables with a delay, under a clock that advances in small steps."""

    def __init__(self, identities: dict[str, Identity], cables: list[tuple[End, End]]) -> None:
        self.now_s = 0.0
        self.nodes: dict[str, HelloProtocol] = {}
        self.far: dict[End, End] = {}
        self.cut: set[End] = set()  # whose frames do not leave
        self.frozen: set[str] = set()
        self.loss = 0.0
        self._chance = random.Random(1)
        self.gone: dict[tuple[str, int], float] = {}
        self._under_way: list[tuple[float, End, bytes, bytes]] = []
        for salt, (name, identity) in enumerate(identities.items(), 1):
            settings = NodeSettings(incarnation=salt, first_sequence=0, random_bytes=Nonces(salt))
            fragmenter = ControlFragmenter(identity.name, salt)
            self.nodes[name] = HelloProtocol(identity, POLICY, fragmenter, settings)
        for one, other in cables:
            self.far[one], self.far[other] = other, one
            for name, port in (one, other):
                self.nodes[name].set_timing(port, SLOW)
                self.nodes[name].add_port(port, self.mac((name, port)), 1_500, 10, 0.0)

    def mac(self, end: End) -> bytes:
        return bytes([2, list(self.nodes).index(end[0]), end[1], 0, 0, 0])

    def run(self, duration_s: float, until: Callable[[], bool] = lambda: False) -> float:
        """Let time pass, at most until a condition holds; return how much has passed."""
        begun_s = self.now_s
        while self.now_s < begun_s + duration_s and not until():
            self.now_s += STEP_S
            self._deliver()
            for name, each in self.nodes.items():
                due_s = each.get_timer()
                if name in self.frozen or due_s is None or due_s > self.now_s:
                    continue
                for neighbour, _ in each.drop_silent(self.now_s):
                    self.gone[name, neighbour.port] = self.now_s
                for sent in each.hellos_to_send(self.now_s):
                    source = name, sent.port
                    if source not in self.cut and sent.mac in (BROADCAST, self.mac(self.far[source])):
                        self._under_way += [
                            (self.now_s + DELAY_S, self.far[source], self.mac(source), frame)
                            for frame in sent.frames
                            if self._chance.random() >= self.loss
                        ]
        return self.now_s - begun_s

    def _deliver(self) -> None:
        ready = [each for each in self._under_way if each[0] <= self.now_s and each[1][0] not in self.frozen]
        self._under_way = [each for each in self._under_way if each not in ready]
        for _, (name, port), mac, frame in ready:
            arrival, now = ReceivedFrame(port, mac, frame), at(self.now_s, UNIX_S + self.now_s)
            header = decode(frame)
            try:
                if header.kind == Kind.KEEPALIVE:
                    self.nodes[name].receive_keepalive(arrival, header, now)
                else:
                    self.nodes[name].receive(arrival, parse(statement_of(frame)), now)
            except RemoteError:  # of a session that has ended
                continue

    def fail(self, end: End) -> None:
        """Cut a cable in both directions."""
        self.cut |= {end, self.far[end]}


@pytest.fixture
def two_links() -> Mesh:
    """Return a robot with two links to one border, which are up."""
    mesh = Mesh({"robot": ROBOT, "border": BORDER}, [(("robot", 0), ("border", 0)), (("robot", 1), ("border", 1))])
    mesh.run(3.0)
    return mesh


@pytest.fixture
def one_uplink() -> Mesh:
    """Return a robot with tunnels to a border (port 0) and to a server (port 1) over one uplink, which are up."""
    mesh = Mesh(
        {"robot": ROBOT, "border": BORDER, "server": SERVER},
        [(("robot", 0), ("border", 0)), (("robot", 1), ("server", 0))],
    )
    for port in (0, 1):
        mesh.nodes["robot"].liveness.set_uplink(port, 0)
    mesh.run(3.0)
    return mesh


def test_a_link_that_fails_alone_is_left_early_although_its_far_end_asks_for_patience(two_links: Mesh) -> None:
    two_links.fail(("robot", 0))
    begun_s = two_links.now_s
    two_links.run(1.0)
    assert set(two_links.gone) == {("robot", 0), ("border", 0)}
    assert max(two_links.gone.values()) - begun_s < 0.2


def test_a_far_end_that_pauses_on_all_links_is_given_its_whole_time(two_links: Mesh) -> None:
    two_links.frozen.add("border")
    two_links.run(0.5)
    assert two_links.gone == {}
    two_links.frozen.clear()
    two_links.run(1.0)
    assert two_links.gone == {}


def test_a_few_lost_keepalives_end_no_link(two_links: Mesh) -> None:
    two_links.fail(("robot", 0))
    two_links.run(0.04)
    two_links.cut.clear()
    two_links.run(1.0)
    assert two_links.gone == {}


def test_after_a_change_of_address_a_tunnel_that_does_not_answer_is_left_at_once(one_uplink: Mesh) -> None:
    one_uplink.fail(("robot", 1))
    begun_s = one_uplink.now_s
    one_uplink.nodes["robot"].probe_uplink(0, begun_s)
    one_uplink.run(0.5)
    assert one_uplink.gone["robot", 1] - begun_s < EARLY_S
    assert ("robot", 0) not in one_uplink.gone


def test_tunnels_that_answer_after_a_change_of_address_stay(one_uplink: Mesh) -> None:
    one_uplink.nodes["robot"].probe_uplink(0, one_uplink.now_s)
    one_uplink.run(2.0)
    assert one_uplink.gone == {}


def test_while_a_new_uplink_is_not_usable_yet_no_tunnel_is_given_up_early(one_uplink: Mesh) -> None:
    for port in (0, 1):
        one_uplink.fail(("robot", port))
    one_uplink.nodes["robot"].probe_uplink(0, one_uplink.now_s)
    one_uplink.run(0.5)
    one_uplink.cut.clear()
    one_uplink.run(1.0)
    assert one_uplink.gone == {}


def test_a_keepalive_to_the_former_address_is_no_answer(one_uplink: Mesh) -> None:
    one_uplink.cut.add(("robot", 1))  # the server still reaches the robot, and does not hear it
    begun_s = one_uplink.now_s
    one_uplink.nodes["robot"].probe_uplink(0, begun_s)
    one_uplink.run(0.5)
    assert one_uplink.gone["robot", 1] - begun_s < EARLY_S


def test_an_address_that_a_border_sees_changed_has_the_other_tunnels_probed(one_uplink: Mesh) -> None:
    border, robot = one_uplink.nodes["border"], one_uplink.nodes["robot"]
    border.set_observed(0, ROBOT.name, Endpoint("192.0.2.1", 40_000))
    one_uplink.run(1.0)
    one_uplink.fail(("robot", 1))  # the NAT has another address
    begun_s = one_uplink.now_s
    border.set_observed(0, ROBOT.name, Endpoint("192.0.2.9", 50_000))
    one_uplink.run(0.5)
    assert robot.neighbours.observed_addresses()[0, BORDER.name].address == "192.0.2.9"
    assert one_uplink.gone["robot", 1] - begun_s < 2 * EARLY_S


def test_with_an_uplink_all_its_silent_tunnels_fail_and_those_that_answer_stay() -> None:
    mesh = Mesh(
        {"robot": ROBOT, "border": BORDER, "server": SERVER, "other": OTHER},
        [
            (("robot", 0), ("border", 0)),
            (("robot", 1), ("border", 1)),
            (("robot", 2), ("server", 0)),
            (("robot", 3), ("other", 0)),
        ],
    )
    for port, uplink in ((0, 0), (1, 1), (2, 0), (3, 0)):
        mesh.nodes["robot"].liveness.set_uplink(port, uplink)
    mesh.run(3.0)
    mesh.fail(("robot", 0))
    mesh.fail(("robot", 2))
    begun_s = mesh.now_s
    mesh.run(0.5)
    assert {end: gone_s - begun_s < 0.25 for end, gone_s in mesh.gone.items() if end[0] == "robot"} == {
        ("robot", 0): True,
        ("robot", 2): True,
    }


def test_a_neighbour_that_polls_is_reported_once(one_uplink: Mesh) -> None:
    border = one_uplink.nodes["border"]
    border.liveness.poll_polled()
    one_uplink.fail(("robot", 1))  # the robot polls its border, too, which may see it elsewhere now
    one_uplink.run(0.3, until=lambda: bool(border.liveness._polled))
    assert border.liveness.poll_polled() == {0}
    assert border.liveness.poll_polled() == frozenset()


def test_a_slow_link_has_more_time_to_answer() -> None:
    quick, slow = LinkQuality(), LinkQuality()
    for number in range(100):
        quick.rtt.add(0.002, number * 0.1)
        slow.rtt.add(0.3, number * 0.1)
    assert patience_s(quick) == 0.05
    assert patience_s(slow) > 0.3
    assert patience_s(LinkQuality()) > patience_s(quick)
    quick.loss_out = 0.05
    assert patience_s(quick) == 0.1


def test_where_a_twentieth_of_the_frames_is_lost_no_link_fails(two_links: Mesh) -> None:
    two_links.loss = 0.05
    two_links.run(60.0)
    assert two_links.gone == {}


def test_one_poll_alone_ends_nothing() -> None:
    probe = LinkProbe(since_s=0.0, polls=1, worked_s=0.0)
    assert probe.fails_at_s(LinkQuality()) == float("inf")


def test_patience_begins_when_another_link_works() -> None:
    probe = LinkProbe(since_s=1.0, polls=9)
    probe.note_other(0.9)  # before the probe: it shows nothing
    assert probe.fails_at_s(LinkQuality()) == float("inf")
    probe.note_other(3.0)
    probe.note_other(4.0)
    assert probe.fails_at_s(LinkQuality()) == 3.0 + patience_s(LinkQuality())
