"""Exclusive control of a robot's topic that two desks publish: hand-over, silence, cuts, and what must not pass."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Final, cast

import pytest

from gdp.control.diagnostics import Question, Reply
from gdp.control.topic_control import NO_READER
from gdp.errors import DropReason
from gdp.message.clock_offset import ClockEstimate
from gdp.metadata import Metadata
from gdp.names import Name
from gdp.ports.plane import Plane
from gdp.sansio import Timestamps
from gdp.state.snapshot import short_id
from gdp.telemetry.sources import Sources
from gdp.trust.right import Right
from proxy.bridge import control_services, imported_topic
from proxy.bridge.cancellation import NO_FIELDS
from proxy.bridge.flow_rows import flow_fields
from proxy.bridge.liveliness import names_from_fields
from proxy.node.control_answer import answer_control
from proxy.node.proxy_state import ProxyState, proxy_handlers
from tests.proxy.bridge.clients import Client
from tests.proxy.bridge.known import channel, channels, services, text_of
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Sites, named, revocation_of
from tests.proxy.endpoints.fake import FakeGraph, Publication

TWIST: Final = "geometry_msgs/msg/Twist"
DRIVE: Final = f"name: /cmd_vel, type: {TWIST}"
OTHER: Final = "nuc3/other"
STOP: Final = -1.0
HZ: Final = 20


def twist(speed: float) -> bytes:
    return b"\0\1\0\0" + struct.pack("<6d", speed, 0, 0, 0, 0, 0)


def graph() -> FakeGraph:
    return FakeGraph(2, {**channels(), TWIST: channel(TWIST)}, services())


def label_of(label: str) -> str:
    """Return the label in the certificate of a member of the simulation."""
    return label.replace("/", "-")


class Drive:
    """A robot, and two desks that publish its ``/cmd_vel``."""

    def __init__(self, sites: Sites, rule: str) -> None:
        self.sites = sites
        steer = f"{DRIVE}, control: exclusive"
        self.desks = {label: sites.add(label, expose=[steer], graph=graph()) for label in (SERVER, OTHER)}
        self.robot = sites.add(ROBOT, imports=[f"{DRIVE}, {rule}"], graph=graph())
        self.ear = Ear(self.robot.graph, "/cmd_vel", TWIST)
        self.sticks: dict[str, Publication] = {}
        for label, desk in self.desks.items():
            desk.graph.now_ns = self.now_ns
            self.sticks[label] = desk.graph.publish("/stick", "/cmd_vel", TWIST)
        identity = sites.world.identities[ROBOT]
        plane = cast(Plane, SimpleNamespace(ports={}))
        policy = sites.world.policy(identity.root.label)
        self.state = ProxyState(identity, policy, plane, self.robot.member, 0.0, {})
        self.state.context, self.state.bridge = self.robot.context, self.robot.bridge
        answer_control(self.state, self.robot.bridge)
        assert sites.run(5, lambda: all(desk.is_read() for desk in self.desks.values()))

    def now_ns(self) -> int:
        return round(1e9 * self.sites.world.network.now.unix_s)

    @property
    def name(self) -> Name:
        """Return the name of the topic."""
        return self.robot.bridge.flows[0][0].name

    @property
    def holder(self) -> Name | None:
        """Return who holds control."""
        found = self.robot.bridge.controlled(self.name)
        assert found is not None
        return found[1].holder

    @property
    def speeds(self) -> list[float]:
        """Return what the robot's base has heard."""
        return [struct.unpack_from("<d", raw, 4)[0] for raw in self.ear.heard]

    def send(self, label: str, **body: object) -> list[Reply | None]:
        """Send a request, whose reply comes into the list that is returned."""
        replies: list[Reply | None] = []
        asked: Mapping[str, object] = {"at": self.now_ns(), **body}
        member, now = self.sites.world.members[label], self.sites.world.network.now
        member.diagnostics.ask(
            self.robot.member.name, "control", now=now, on_reply=lambda reply, _: replies.append(reply), name=self.name,
            body=asked, timeout_s=2.0, reply_bytes=1_024,
        )  # fmt: skip
        self.sites.world.network.send_pending(label)
        return replies

    def ask(self, label: str, **body: object) -> Mapping[str, object]:
        """Return the answer to a request."""
        replies = self.send(label, **body)
        assert self.sites.run(3, lambda: bool(replies))
        (reply,) = replies
        assert reply is not None
        return reply.result

    def act(self, label: str, act: str, **body: object) -> Mapping[str, object]:
        """Return the answer to a request that knows the present state."""
        return self.ask(label, do=act, seen=self.ask(label)["generation"], **body)

    def drive(self, label: str, speed: float, duration_s: float = 0.5) -> None:
        """Publish at a desk for a while, and let everything arrive."""
        self.sites.every(1 / HZ, round(duration_s * HZ), lambda _: self.sticks[label].publish(twist(speed)))
        self.sites.run(duration_s)

    def call(self, label: str, act: str) -> tuple[bool, str]:
        """Return what a local service of a machine answers."""
        machine = self.robot if label == ROBOT else self.desks[label]
        client = Client(machine.graph, f"/cmd_vel/control/{act}")
        client.call(NO_FIELDS[2])
        assert self.sites.run(5, lambda: bool(client.got[0]))
        (raw,) = client.got[0]
        assert isinstance(raw, bytes), raw
        return raw[4] == 1, text_of(raw[4:])

    def drops(self, reason: DropReason) -> int:
        return self.robot.member.drops().get(reason, 0)


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


@pytest.fixture
def drive(sites: Sites) -> Drive:
    return Drive(sites, f"control: {{silence_s: 0.5, stop: {{linear: {{x: {STOP}}}}}}}")


def test_nothing_drives_before_control_is_taken_and_then_its_holder_alone(drive: Drive) -> None:
    drive.drive(SERVER, 1.0)
    assert drive.speeds == []
    assert drive.act(SERVER, "take")["error"] == ""
    drive.sites.every(1 / HZ, HZ, lambda _: drive.sticks[OTHER].publish(twist(2.0)))
    drive.drive(SERVER, 1.0)
    assert set(drive.speeds) == {1.0}
    assert drive.drops(DropReason.NOT_IN_CONTROL) >= HZ // 2
    assert drive.robot.faults == {"not-in-control": drive.drops(DropReason.NOT_IN_CONTROL)}


def test_silence_is_answered_by_one_stop_and_the_holder_drives_on_afterwards(drive: Drive) -> None:
    drive.act(SERVER, "take")
    drive.drive(SERVER, 1.0)
    begun_s = drive.sites.now_s
    assert drive.sites.run(2, lambda: drive.speeds[-1] == STOP)
    assert drive.sites.now_s - begun_s <= 0.51
    drive.sites.run(5)
    assert drive.speeds.count(STOP) == 1
    assert drive.ask(SERVER)["state"] == "silent"
    drive.drive(SERVER, 3.0)
    assert drive.speeds[-1] == 3.0


def test_a_holder_that_dies_is_stopped_and_loses_control(drive: Drive) -> None:
    drive.act(SERVER, "take")
    drive.drive(SERVER, 1.0)
    drive.sites.kill(drive.desks[SERVER])
    assert drive.sites.run(1, lambda: drive.speeds[-1] == STOP)
    assert drive.sites.run(60, lambda: drive.holder is None)
    assert drive.act(OTHER, "take")["error"] == ""
    drive.drive(OTHER, 2.0)
    assert drive.speeds.count(STOP) == 1
    assert drive.speeds[-1] == 2.0


def test_what_waited_while_the_network_was_cut_does_not_drive(drive: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imported_topic, "time", SimpleNamespace(time_ns=drive.now_ns))
    drive.robot.member.diagnostics.clock_of = lambda *_: ClockEstimate(0.0, 0.01)  # type: ignore[method-assign]
    drive.act(SERVER, "take")
    drive.drive(SERVER, 1.0)
    drive.sites.world.network.freeze("nuc3")
    for speed in (5.0, 6.0, 7.0):
        drive.drive(SERVER, speed, 0.3)
    assert drive.speeds[-1] == STOP
    drive.sites.world.network.thaw("nuc3")
    drive.drive(SERVER, 8.0)
    driven = drive.speeds[drive.speeds.index(STOP) + 1 :]
    assert driven
    assert 5.0 not in driven
    assert drive.drops(DropReason.LATE)


def test_control_is_handed_over_while_moving_and_the_former_holder_is_not_heard(drive: Drive) -> None:
    drive.act(SERVER, "take")
    for label in drive.desks:
        speed = 1.0 if label == SERVER else 2.0
        drive.sites.every(1 / HZ, 3 * HZ, lambda _, each=label, its=speed: drive.sticks[each].publish(twist(its)))  # type: ignore[misc]
    drive.sites.run(1)
    assert set(drive.speeds) == {1.0}
    given = drive.act(SERVER, "give", to=label_of(OTHER))
    assert (given["error"], given["state"]) == ("", "held")
    at = len(drive.speeds)
    drive.sites.run(1)
    assert set(drive.speeds[at:]) == {2.0}
    assert STOP not in drive.speeds


def test_a_new_holder_that_sends_nothing_is_stopped(drive: Drive) -> None:
    drive.act(SERVER, "take")
    drive.drive(SERVER, 1.0)
    drive.act(SERVER, "give", to=label_of(OTHER))
    assert drive.speeds[-1] == 1.0
    assert drive.sites.run(0.6, lambda: drive.speeds[-1] == STOP)


def test_control_that_is_given_to_none_stops_at_once(drive: Drive) -> None:
    drive.act(SERVER, "take")
    drive.drive(SERVER, 1.0)
    assert drive.act(SERVER, "give")["state"] == "free"
    assert drive.sites.run(0.1, lambda: drive.speeds[-1] == STOP)


def test_of_two_who_take_at_the_same_instant_one_gets_control(drive: Drive) -> None:
    seen = drive.ask(SERVER)["generation"]
    both = [drive.send(label, do="take", seen=seen) for label in drive.desks]
    assert drive.sites.run(3, lambda: all(both))
    answers = [reply.result for replies in both for reply in replies if reply is not None]
    assert sorted(answer["error"] == "" for answer in answers) == [False, True]
    assert len({answer["holder"] for answer in answers}) == 1


def test_a_recorded_request_is_worth_nothing_after_a_change(drive: Drive) -> None:
    seen = drive.ask(SERVER)["generation"]
    assert drive.ask(SERVER, do="take", seen=seen)["error"] == ""
    drive.act(OTHER, "take", force=True)
    assert "has changed" in str(drive.ask(SERVER, do="take", seen=seen, force=True)["error"])
    assert drive.ask(SERVER)["peer"] == bytes(drive.desks[OTHER].member.name)


def test_who_does_not_publish_the_topic_can_neither_take_nor_give_control(drive: Drive) -> None:
    drive.act(SERVER, "take")
    stranger = drive.sites.add("nuc1/stranger")
    assert "only a publisher" in str(drive.act(stranger.label, "take", force=True)["error"])
    assert "only who holds" in str(drive.act(OTHER, "give")["error"])
    assert "label" in str(drive.act(SERVER, "give", to="nothing")["error"])
    assert drive.ask(SERVER)["holder"] == label_of(SERVER)


def test_the_robot_itself_may_give_control(drive: Drive) -> None:
    drive.act(SERVER, "take")
    assert drive.act(ROBOT, "give", to=label_of(OTHER))["holder"] == label_of(OTHER)


def test_a_holder_that_loses_its_grant_is_stopped_and_loses_control(drive: Drive) -> None:
    drive.act(SERVER, "take")
    drive.drive(SERVER, 1.0)
    world, topic = drive.sites.world, drive.desks[SERVER].bridge.held.find(drive.name, Right.PUBLISH)
    assert topic is not None
    world.switches["nuc3"].revoke(revocation_of(world, topic), world.network.now)
    world.network.send_pending("nuc3")
    drive.drive(SERVER, 1.0, 2.0)
    assert drive.speeds[-1] == STOP
    assert drive.speeds.count(STOP) == 1
    assert drive.ask(ROBOT)["state"] == "free"


def test_a_proxy_that_ends_leaves_the_robot_with_a_stop(drive: Drive) -> None:
    drive.act(SERVER, "take")
    drive.drive(SERVER, 1.0)
    drive.robot.bridge.close()
    assert drive.speeds[-1] == STOP


def test_a_stop_that_does_not_fit_its_type_is_a_problem_at_the_start(sites: Sites) -> None:
    robot = sites.add(ROBOT, imports=[f"{DRIVE}, control: {{stop: {{speed: 1}}}}"], graph=graph())
    sites.run(1)
    (problem,) = robot.bridge.problems
    assert (problem.local, robot.carried) == ("/cmd_vel", set())
    assert problem.detail.startswith("control: stop does not fit geometry_msgs/msg/Twist: ")


def test_a_type_that_the_robot_does_not_have_is_stopped_by_the_far_definition(sites: Sites) -> None:
    desk = sites.add(SERVER, expose=[DRIVE], graph=graph())
    robot = sites.add(ROBOT, imports=[f"{DRIVE}, control: exclusive"])
    ear, stick = Ear(robot.graph, "/cmd_vel", TWIST), desk.graph.publish("/stick", "/cmd_vel", TWIST)
    assert sites.run(5, desk.is_read)
    name = robot.bridge.flows[0][0].name
    _, control = robot.bridge.controlled(name) or pytest.fail("no control")
    control.take(desk.member.name, sites.now_s, since_ns=0, force=False)
    stick.publish(twist(1.0))
    assert sites.run(2, lambda: len(ear.heard) == 2)
    assert ear.heard == [twist(1.0), twist(0.0)]


@pytest.mark.parametrize("second", ["", ", control: exclusive"])
def test_another_name_does_not_bring_a_topic_past_its_control(drive: Drive, second: str) -> None:
    other, held = f"{DRIVE}, metadata: {{of: other}}", named("/cmd_vel", TWIST)
    rule = f"{DRIVE}, control: {{silence_s: 0.5, stop: {{linear: {{x: {STOP}}}}}}}"
    drive.sites.reload(drive.desks[OTHER], expose=[other])
    imports = [rule, f"name: /**, metadata: {{of: other}}{second}"]
    drive.sites.reload(drive.robot, imports=imports, holds=[held, Metadata({**held, "of": "other"})])
    drive.sites.run(2)
    drive.act(SERVER, "take")
    drive.drive(OTHER, 2.0)
    assert drive.speeds == []
    (problem,) = drive.robot.bridge.problems
    assert "use one name" in problem.detail
    drive.drive(SERVER, 1.0)
    assert drive.speeds[-1] == 1.0


def test_holder_and_refused_messages_are_shown(drive: Drive) -> None:
    drive.act(SERVER, "take")
    drive.drive(OTHER, 1.0)
    holder = drive.desks[SERVER].member.name
    (name,) = drive.robot.bridge.liveliness(drive.sites.now_s)
    assert {party.node for party in name.parties if party.has_control} == {holder.to_text()}
    assert [party.has_control for party in next(names_from_fields([name.to_fields()])).parties].count(True) == 1
    handlers = proxy_handlers(drive.state, Sources())
    (row,) = cast("list[dict[str, object]]", handlers.show({"what": "control"})["rows"])
    assert (row["local"], row["holder"], row["peer"]) == ("/cmd_vel", label_of(SERVER), holder.to_text())
    assert cast(int, row["refused"]) >= 5
    (flow,) = (flow_fields(*each) for each in drive.robot.bridge.flows)
    assert flow["holder"] == short_id(holder)


@pytest.fixture
def clocked(drive: Drive, monkeypatch: pytest.MonkeyPatch) -> Drive:
    """Return the machines, whose proxies state the time of the simulation."""
    clock = SimpleNamespace(time_ns=drive.now_ns, time=lambda: drive.now_ns() / 1e9)
    monkeypatch.setattr(control_services, "time", clock)
    return drive


def test_local_nodes_take_give_and_look_at_control_by_services(clocked: Drive) -> None:
    robot, first, second = label_of(ROBOT), label_of(SERVER), label_of(OTHER)
    assert clocked.call(SERVER, "show") == (False, f"{robot}: free")
    assert clocked.call(SERVER, "take") == (True, f"{robot}: held by {first}")
    clocked.drive(SERVER, 1.0)
    assert set(clocked.speeds) == {1.0}
    assert clocked.call(SERVER, "show") == (True, f"{robot}: held by {first}")
    is_taken, text = clocked.call(OTHER, "take")
    assert (is_taken, clocked.holder) == (False, clocked.desks[SERVER].member.name)
    assert text.startswith(f"{robot}: another publisher holds control")
    is_given, text = clocked.call(OTHER, "give")
    assert (is_given, "only who holds control" in text) == (False, True)
    assert clocked.call(SERVER, "give") == (True, f"{robot}: free")
    assert clocked.sites.run(0.1, lambda: clocked.speeds[-1] == STOP)
    assert clocked.call(OTHER, "take") == (True, f"{robot}: held by {second}")


def test_a_node_at_the_robot_takes_control_from_everybody(clocked: Drive) -> None:
    clocked.call(SERVER, "take")
    clocked.drive(SERVER, 1.0)
    assert clocked.call(ROBOT, "give") == (True, f"{label_of(ROBOT)}: free")
    assert clocked.sites.run(0.1, lambda: clocked.speeds[-1] == STOP)


def test_who_lost_the_right_to_publish_takes_nothing_by_a_service(clocked: Drive) -> None:
    world, topic = clocked.sites.world, clocked.desks[SERVER].bridge.held.find(clocked.name, Right.PUBLISH)
    assert topic is not None
    world.switches["nuc3"].revoke(revocation_of(world, topic), world.network.now)
    world.network.send_pending("nuc3")
    clocked.sites.run(2)
    is_taken, _ = clocked.call(SERVER, "take")
    assert (is_taken, clocked.holder) == (False, None)


def test_a_topic_without_a_reader_under_control_and_a_silent_reader_are_named(clocked: Drive) -> None:
    clocked.sites.reload(clocked.robot, imports=[DRIVE])
    clocked.sites.run(2)
    assert clocked.call(SERVER, "take") == (False, NO_READER)
    asked: list[str] = []

    def only_show(question: Question, now: Timestamps) -> Mapping[str, object] | None:
        asked.append(str(question.body.get("do")))
        return {"state": "free", "generation": 1} if len(asked) == 1 else {}

    clocked.robot.member.diagnostics.register("control", only_show, for_foreign=True)
    is_taken, text = clocked.call(SERVER, "take")
    assert (is_taken, asked) == (False, ["None", "take"])
    assert "no answer: it may have been done" in text


def test_services_go_with_their_topic_and_a_graph_without_the_type_says_so(sites: Sites) -> None:
    poor = FakeGraph(2, {**channels(), TWIST: channel(TWIST)}, {})
    rule = f"{DRIVE}, control: exclusive"
    desk, other = sites.add(SERVER, expose=[rule], graph=graph()), sites.add(OTHER, expose=[rule], graph=poor)
    publications = [each.graph.publish("/stick", "/cmd_vel", TWIST) for each in (desk, other)]
    assert sites.run(5, lambda: bool(desk.carried and other.carried))
    assert sorted(each.end.name for each in desk.graph.servers) == [
        f"/cmd_vel/control/{act}" for act in ("give", "show", "take")
    ]
    assert other.faults == {"unknown-type": 1}
    publications[0].close()
    assert sites.run(20, lambda: not desk.graph.servers)
