"""Recordings as endpoints of a bridge: messages replayed on one machine are recorded on another."""

from __future__ import annotations

import select
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
from mcap.reader import make_reader

from gdp.errors import LocalError
from proxy.bridge.bridge import Bridge
from proxy.bridge.context import BridgeContext
from proxy.bridge.counters import Traffic
from proxy.bridge.faults import Faults
from proxy.config.recorded import RecordedRules
from proxy.endpoints.core.endpoint import GraphChanged, MessageReceived, Origin, TypeResolved
from proxy.recordings.endpoint import RecordingEndpoint, ReplayEndpoint
from proxy.recordings.reader import BagReader
from proxy.recordings.writer import BagWriter
from proxy.serial.channel import Channel, Qos, RosVersion
from tests.insiders.oracle import signing_oracle
from tests.proxy.bridge import known
from tests.proxy.bridge.known import IMAGE, STRING
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites
from tests.proxy.endpoints.fake import FakeEndpoint, FakeGraph
from tests.proxy.recordings.test_reader import LATCHED, PLAIN, START_NS, raw, string

CHATTER = f"name: /chatter, type: {STRING}, encoding: cdr"


class FullWriter:
    """Recording on a full disk."""

    path = Path("full.mcap")
    ros: RosVersion = 2

    def add(self, channel: Channel) -> int:
        return 0

    def write(self, handle: int, stamp_ns: int, raw: bytes, origin: Origin | None = None) -> None:
        raise LocalError("full.mcap cannot be written: No space left on device")


@pytest.fixture(autouse=True)
def _signatures() -> Iterator[None]:
    """Sign by the ideal scheme: what crosses is the subject."""
    with signing_oracle():
        yield


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


@pytest.fixture
def replayed(tmp_path: Path) -> Iterator[ReplayEndpoint]:
    """Two talkers of ROS 1 on one topic, and a topic that no rule names."""
    path = tmp_path / "sent.bag"
    record(path, 1, [string(1, callerid="/a"), string(1, callerid="/b", latched=True), string(1, "/local")])
    yield from opened(path)


def opened(path: Path) -> Iterator[ReplayEndpoint]:
    with BagReader(path) as reader:
        yield ReplayEndpoint(reader)


def record(path: Path, ros: RosVersion, channels: Sequence[Channel]) -> None:
    """Record three messages of each channel."""
    with BagWriter(path, ros) as bag:
        handles = [bag.add(channel) for channel in channels]
        for number in range(3):
            for handle in handles:
                bag.write(handle, START_NS + number, raw(ros, b"%d of %d" % (number, handle)))


def join(
    sites: Sites,
    label: str,
    endpoint: ReplayEndpoint | RecordingEndpoint,
    *,
    expose: Sequence[str] = (),
    imports: Sequence[str] = (),
) -> Machine:
    """Start a bridge between a recording and the overlay."""
    sites.world.add_member(label, label.partition("/")[0])
    assert sites.world.run_until_attached()
    member, config = sites.world.members[label], sites.config(expose, imports)
    context = BridgeContext(member, Traffic(), Faults())
    rules = RecordedRules.of(expose=config.expose, imports=config.imports)
    bridge = Bridge(context, rules, [endpoint], sites.held(member, config))
    ends = [cast(FakeEndpoint, endpoint)]
    machine = Machine(label, member, FakeGraph(endpoint.ros, {}), ends, context, bridge)
    sites.machines.append(machine)
    return machine


def play(sites: Sites, endpoint: ReplayEndpoint) -> None:
    for message in endpoint.messages():
        endpoint.deliver(message)
        sites.run(0.01)


def cross(sites: Sites, endpoint: ReplayEndpoint, copy: Path) -> None:
    """Replay at the robot, and record at the server."""
    with BagWriter(copy, endpoint.ros) as writer:
        robot = join(sites, ROBOT, endpoint, expose=[CHATTER])
        join(sites, SERVER, RecordingEndpoint(writer, [("/chatter", STRING)]), imports=[CHATTER])
        assert sites.run(3, robot.is_read)
        play(sites, endpoint)
        assert sites.run(3, robot.stream.is_acknowledged)
        sites.run(0.1)


def test_every_publisher_of_a_recorded_topic_is_recorded_as_itself(
    sites: Sites, replayed: ReplayEndpoint, tmp_path: Path
) -> None:
    copy = tmp_path / "received.bag"
    cross(sites, replayed, copy)
    with BagReader(copy) as bag:
        assert {(each.topic, each.callerid, each.latched) for each in bag.channels} == {
            ("/chatter", "/a", False),
            ("/chatter", "/b", True),
        }
        got = {(bag.channels[message.channel].callerid, message.raw) for message in bag.messages()}
    assert got == {(who, raw(1, b"%d of %d" % (n, at))) for n in range(3) for at, who in enumerate(("/a", "/b"))}


def test_recorded_qos_profiles_arrive_unchanged(sites: Sites, tmp_path: Path) -> None:
    path, copy = tmp_path / "sent.mcap", tmp_path / "received.mcap"
    record(path, 2, [string(2, qos=(LATCHED, PLAIN), latched=True)])
    for endpoint in opened(path):
        cross(sites, endpoint, copy)
    with BagReader(copy) as bag:
        (channel,) = bag.channels
    assert channel.qos == (LATCHED, PLAIN)


def test_a_recording_holds_no_sign_of_the_proxy(sites: Sites, replayed: ReplayEndpoint, tmp_path: Path) -> None:
    copy = tmp_path / "received.bag"
    cross(sites, replayed, copy)
    with BagReader(copy) as bag:
        assert {channel.topic for channel in bag.channels} == {"/chatter"}


def test_a_recorded_topic_without_a_rule_stays_local(sites: Sites, replayed: ReplayEndpoint) -> None:
    robot = join(sites, ROBOT, replayed, expose=[CHATTER])
    sites.run(1)
    assert robot.carried == {("/chatter", True)}
    assert [replayed.is_subscribed(index) for index in range(3)] == [True, True, False]


def test_a_recorded_topic_has_the_local_name_of_its_rule(
    sites: Sites, replayed: ReplayEndpoint, tmp_path: Path
) -> None:
    copy = tmp_path / "received.bag"
    with BagWriter(copy, 1) as writer:
        robot = join(sites, ROBOT, replayed, expose=[CHATTER])
        recorded = RecordingEndpoint(writer, [("/heard", STRING)])
        join(sites, SERVER, recorded, imports=[f"{CHATTER}, remap: /heard"])
        assert sites.run(3, robot.is_read)
        play(sites, replayed)
        assert sites.run(3, robot.stream.is_acknowledged)
        sites.run(0.1)
    with BagReader(copy) as bag:
        assert {channel.topic for channel in bag.channels} == {"/heard"}


def test_two_types_of_one_recorded_topic_cross_as_two(sites: Sites, tmp_path: Path) -> None:
    path = tmp_path / "sent.bag"
    record(path, 1, [string(1), string(1, type_name="std_msgs/msg/Other")])
    for endpoint in opened(path):
        robot = join(sites, ROBOT, endpoint, expose=[CHATTER, "name: /chatter, type: std_msgs/msg/Other"])
        sites.run(1)
        assert {flow_spec.type_name for flow_spec, _ in robot.bridge.flows} == {STRING, "std_msgs/msg/Other"}
        assert robot.faults == {}


def test_a_live_listener_gets_the_messages_of_every_recorded_publisher(sites: Sites, replayed: ReplayEndpoint) -> None:
    robot = join(sites, ROBOT, replayed, expose=[CHATTER])
    server = sites.add(SERVER, imports=[CHATTER], ros=1)
    ear = Ear(server.graph, "/chatter")
    assert sites.run(3, robot.is_read)
    play(sites, replayed)
    assert sites.run(3, lambda: len(ear.heard) == 6)
    assert ear.texts == [f"{number} of {at}" for number in range(3) for at in range(2)]


def test_a_recording_keeps_the_publishers_time_number_and_qos(sites: Sites, tmp_path: Path) -> None:
    offered = Qos(depth=7, reliability="best_effort", durability="volatile", lifespan=(2, 0))
    robot = sites.add(ROBOT, expose=[CHATTER])
    talker = robot.graph.publish("/talker", "/chatter", STRING, offered)
    with BagWriter(tmp_path / "heard.mcap", 2) as writer:
        join(sites, SERVER, RecordingEndpoint(writer, [("/chatter", STRING)]), imports=[CHATTER])
        assert sites.run(3, robot.is_read)
        for text in (b"one", b"two"):
            talker.publish(raw(2, text))
            sites.run(0.2)
    taken_ns = 0  # the fake graph's stamp of each message
    with (tmp_path / "heard.mcap").open("rb") as file:
        messages = [message for _, _, message in make_reader(file).iter_messages()]
    assert [(each.sequence, each.publish_time) for each in messages] == [(1, taken_ns), (2, taken_ns)]
    assert 0 < messages[0].log_time <= messages[1].log_time
    with BagReader(tmp_path / "heard.mcap") as bag:
        assert [each.qos for each in bag.channels] == [(offered,)]


def test_messages_of_the_other_ros_are_refused_and_counted(
    sites: Sites, replayed: ReplayEndpoint, tmp_path: Path
) -> None:
    with BagWriter(tmp_path / "received.mcap", 2) as writer:
        robot = join(sites, ROBOT, replayed, expose=[CHATTER])
        server = join(sites, SERVER, RecordingEndpoint(writer, [("/chatter", STRING)]), imports=[CHATTER])
        assert sites.run(3, robot.is_read)
        play(sites, replayed)
        (stats,) = server.bridge.stats
        assert (stats.received, stats.refused, server.faults) == (0, 6, {"refused": 1})


def test_a_message_that_cannot_be_written_is_counted_as_refused(sites: Sites, tmp_path: Path) -> None:
    path = tmp_path / "sent.mcap"
    record(path, 2, [string(2)])
    full = RecordingEndpoint(cast(BagWriter, FullWriter()), [("/chatter", STRING)])
    for endpoint in opened(path):
        robot, server = join(sites, ROBOT, endpoint, expose=[CHATTER]), join(sites, SERVER, full, imports=[CHATTER])
        assert sites.run(3, robot.is_read)
        play(sites, endpoint)
        sites.run(0.1)
        (stats,) = server.bridge.stats
        assert (stats.received, stats.lost, server.faults) == (0, 3, {"refused": 3})


def test_without_a_file_messages_are_counted(sites: Sites, replayed: ReplayEndpoint) -> None:
    robot = join(sites, ROBOT, replayed, expose=[CHATTER])
    server = join(sites, SERVER, RecordingEndpoint(None, [("/chatter", STRING)]), imports=[CHATTER])
    assert sites.run(3, robot.is_read)
    play(sites, replayed)
    sites.run(0.1)
    (stats,) = server.bridge.stats
    assert (stats.received, stats.lost) == (6, 0)


def test_a_replayed_topic_is_reliable_unless_its_rule_says_otherwise(sites: Sites, tmp_path: Path) -> None:
    path = tmp_path / "sent.mcap"
    record(path, 2, [string(2, qos=(PLAIN,)), string(2, "/other", qos=(PLAIN,))])
    for endpoint in opened(path):
        other = f"name: /other, type: {STRING}, reliable: false"
        robot = join(sites, ROBOT, endpoint, expose=[CHATTER, other])
        sites.run(1)
        assert sorted(each.confirms for each in list(robot.member.publications)) == [False, True]


def test_a_replayed_message_is_of_use_for_the_lifespan_that_was_recorded(sites: Sites, tmp_path: Path) -> None:
    path = tmp_path / "sent.mcap"
    record(path, 2, [string(2, qos=(replace(PLAIN, lifespan=(0, 500_000_000)),))])
    for endpoint in opened(path):
        robot = join(sites, ROBOT, endpoint, expose=[f"{CHATTER}, reliable: false"])
        sites.run(1)
        assert [each.options.deadline_s for each in list(robot.member.publications)] == [0.5]


def test_a_late_recorder_gets_the_last_message_of_a_latched_recording(sites: Sites, tmp_path: Path) -> None:
    path = tmp_path / "sent.mcap"
    record(path, 2, [string(2, qos=(LATCHED,), latched=True)])
    for endpoint in opened(path):
        robot = join(sites, ROBOT, endpoint, expose=[CHATTER])
        sites.run(1)
        play(sites, endpoint)
        server = join(sites, SERVER, RecordingEndpoint(None, [("/chatter", STRING)]), imports=[CHATTER])
        assert sites.run(3, robot.is_read)
        sites.run(1)
        (stats,) = server.bridge.stats
        assert stats.received == 1


def test_a_message_above_the_rules_limit_is_not_published_but_counted(sites: Sites, replayed: ReplayEndpoint) -> None:
    robot = join(sites, ROBOT, replayed, expose=[f"{CHATTER}, max_bytes: 4"])
    join(sites, SERVER, RecordingEndpoint(None, [("/chatter", STRING)]), imports=[CHATTER])
    assert sites.run(3, robot.is_read)
    play(sites, replayed)
    sites.run(0.1)
    assert robot.stream.losses.by_label() == {"too-large": 6}
    assert robot.faults == {"too-large": 6}


def test_max_hz_leaves_out_no_message_of_a_recording(sites: Sites, replayed: ReplayEndpoint) -> None:
    rule = f"{CHATTER}, max_hz: 1"
    robot = join(sites, ROBOT, replayed, expose=[rule])
    server = join(sites, SERVER, RecordingEndpoint(None, [("/chatter", STRING)]), imports=[rule])
    assert sites.run(3, robot.is_read)
    play(sites, replayed)
    sites.run(0.1)
    (stats,) = server.bridge.stats
    assert (stats.received, robot.context.traffic.thinned) == (6, 0)


def test_a_replayed_topic_has_the_name_that_all_sides_know(sites: Sites, replayed: ReplayEndpoint) -> None:
    robot = join(sites, ROBOT, replayed, expose=[f"{CHATTER}, remap: /local"])
    sites.run(1)
    assert robot.carried == {("/chatter", True)}


def test_a_subscription_is_described_with_every_channel_before_its_first_message(replayed: ReplayEndpoint) -> None:
    handle = replayed.subscribe("/chatter", STRING, None)
    for message in replayed.messages():
        replayed.deliver(message)
        break
    changed, described, heard = replayed.poll_events()
    assert changed == GraphChanged()
    assert isinstance(described, TypeResolved)
    assert [each.callerid for each in (described.channel, *described.others)] == ["/a", "/b"]
    assert isinstance(heard, MessageReceived)
    assert (heard.handle, heard.channel, heard.raw) == (handle, 0, raw(1, b"0 of 0"))


def test_a_topic_that_is_closed_gives_no_more_messages(replayed: ReplayEndpoint) -> None:
    replayed.close(replayed.subscribe("/chatter", STRING, None))
    assert list(replayed.messages()) == []


def test_a_topic_of_another_type_cannot_be_subscribed_to(replayed: ReplayEndpoint) -> None:
    with pytest.raises(LocalError, match=f"it has no topic /chatter of type {IMAGE}"):
        replayed.subscribe("/chatter", IMAGE, None)


def test_the_descriptor_is_readable_while_there_are_events(replayed: ReplayEndpoint) -> None:
    assert select.select([replayed], [], [], 0)[0]
    replayed.poll_events()
    assert not select.select([replayed], [], [], 0)[0]


def test_an_equal_channel_has_one_handle(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "received.bag", 1) as writer:
        endpoint = RecordingEndpoint(writer, [("/chatter", STRING)])
        assert endpoint.advertise(string(1, callerid="/a")) == endpoint.advertise(string(1, callerid="/a"))
        assert endpoint.advertise(string(1, callerid="/a")) != endpoint.advertise(string(1, callerid="/b"))


def test_a_recording_serves_and_calls_nothing() -> None:
    endpoint = RecordingEndpoint(None, [])
    service = known.services(2)[known.SET_BOOL]
    with pytest.raises(LocalError, match="a recording holds topics only"):
        endpoint.serve(service)
    with pytest.raises(LocalError, match="a recording holds topics only"):
        endpoint.create_client("/switch", known.SET_BOOL)
