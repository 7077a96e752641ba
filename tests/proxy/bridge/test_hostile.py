"""Remote peers with every right, and graphs that refuse: the proxy continues and reports every fault."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gdp.control.boundary import ErrorBoundary
from gdp.errors import LocalError
from gdp.service.frames import Answer, Outcome, Request
from proxy.endpoints.core.qos import default
from proxy.serial.channel import Channel, Qos
from proxy.wire.message import RosMessage, TopicDescription
from proxy.wire.service import Exchange, News
from tests.proxy.bridge import known
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, STRING, string, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Machine, Sites

pytestmark = pytest.mark.real_signatures
CHATTER = f"name: /chatter, type: {STRING}"
OTHER = f"name: /other, type: {STRING}"
SWITCH = f"kind: service, name: /switch, type: {SET_BOOL}"
SERVICE = known.services()[SET_BOOL]
JUNK = [b"", b"\1", b"\1\0" + bytes(8), b"\1\0" + bytes(60), b"\7" * 40, b"\1\xff" + bytes(40)]


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def listening(sites: Sites) -> tuple[Machine, Machine, Ear]:
    """Return a machine whose publisher may send anything, the machine that reads it, and a listener there."""
    robot, server = sites.add(ROBOT, expose=[CHATTER]), sites.add(SERVER, imports=[CHATTER])
    ear = Ear(server.graph, "/chatter")
    robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    sites.run(0.5)  # until the bridge has described the topic itself
    return robot, server, ear


def say(sites: Sites, robot: Machine, channel: Channel, body: bytes) -> None:
    robot.stream.describe(TopicDescription("cdr", (channel,)).to_wire())
    robot.member.flush(sites.now_s)
    sites.world.network.send_pending(robot.label)
    sites.run(0.5)
    robot.stream.publish(RosMessage(0, 1, body).to_wire())
    robot.member.flush(sites.now_s)
    sites.world.network.send_pending(robot.label)
    sites.run(0.5)


def test_a_name_on_which_the_library_fails_ends_neither_the_proxy_nor_other_flows(
    sites: Sites, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ErrorBoundary, "reraises", False)
    robot, server = sites.add(ROBOT, expose=[CHATTER, OTHER]), sites.add(SERVER, imports=[CHATTER, OTHER])
    ear, subscribe = Ear(server.graph, "/chatter"), robot.endpoint.subscribe

    def failing(topic: str, type_name: str, qos: Qos | None) -> int:
        if topic == "/other":
            raise KeyError(topic)  # as a library does that this program does not know
        return subscribe(topic, type_name, qos)

    monkeypatch.setattr(robot.endpoint, "subscribe", failing)
    robot.graph.publish("/talker", "/other", STRING)
    talker = robot.graph.publish("/talker", "/chatter", STRING)
    assert sites.run(3, robot.is_read)
    talker.publish(string("hello"))
    assert sites.run(1, lambda: ear.texts == ["hello"])
    assert robot.carried == {("/chatter", True)}
    assert [(each.local, each.detail) for each in robot.bridge.problems] == [("/other", "an error here; see the log")]


def test_a_far_depth_without_bound_is_bounded_here(sites: Sites) -> None:
    robot, server, ear = listening(sites)
    endless = replace(default(latched=True), depth=1 << 63)
    say(sites, robot, replace(known.channel(STRING), topic="/chatter", qos=(endless,)), string("hello"))
    assert ear.texts == ["hello"]
    (offered,) = (each.qos for each in server.graph.publications if each.end.name == "/chatter")
    assert 1 <= offered.depth <= 1_000


@pytest.mark.parametrize(
    "channel",
    [
        replace(known.channel(STRING), type_name=known.IMAGE),
        replace(known.channel(STRING), definition="", definition_format="", hash="RIHS01_0"),
        replace(known.channel(STRING), definition="string[] data\n", hash="RIHS01_0"),
        replace(known.channel(STRING), definition="nonsense", hash="RIHS01_0"),
        replace(known.channel(STRING), definition="std_msgs/String data\n", hash="RIHS01_0"),
        replace(known.channel(STRING, 1), definition="", definition_format=""),
        replace(known.channel(STRING, 1), definition="string " * 1_000),
    ],
    ids=["type", "no definition", "definition", "nonsense", "itself", "ROS 1 without", "ROS 1 nonsense"],
)
def test_a_description_that_does_not_fit_is_reported_and_the_topic_goes_on_with_one_that_does(
    sites: Sites, channel: Channel
) -> None:
    robot, server, ear = listening(sites)
    say(sites, robot, channel, string("?"))
    assert (ear.heard, set(server.faults)) == ([], {"other-type"})
    say(sites, robot, known.channel(STRING), string("hello"))
    assert ear.texts == ["hello"]


@pytest.mark.parametrize("wire", JUNK)
def test_requests_that_are_none_do_not_stop_a_server(sites: Sites, wire: bytes) -> None:
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH])
    LocalServer(server.graph, answer=lambda _: switched("yes"))
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    client.stream.publish(wire)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == [switched("yes")])


@pytest.mark.parametrize(
    "wire",
    [
        *JUNK,
        Answer(7, 1, Outcome.ANSWERED, b"").to_wire(),
        News(9, 1, b"").to_wire(),
        Request(0, 1, 0, b"").to_wire(),
    ],
)
def test_answers_and_news_that_are_none_do_not_stop_a_client(sites: Sites, wire: bytes) -> None:
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH])
    LocalServer(server.graph, answer=lambda _: switched("yes"))
    caller = Client(client.graph)
    assert sites.run(3, caller.sees_server)
    server.stream.publish(wire)
    server.member.services.respond(server.stream.topic, client.member.name, wire)
    sites.run(1)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: caller.outcomes == [switched("yes")])


@pytest.mark.parametrize(
    "description",
    [
        b"nonsense",
        Exchange("json", (SERVICE, SERVICE)).to_cbor(),
        Exchange("json", (replace(SERVICE, type_name="other_srvs/srv/Other"),)).to_cbor(),
        Exchange("json", (replace(SERVICE, request=known.channel(known.IMAGE)),)).to_cbor(),
        Exchange("json", (replace(SERVICE, response=known.channel(known.IMAGE)),)).to_cbor(),
    ],
    ids=["nonsense", "two parts", "another type", "another request", "another response"],
)
def test_a_server_that_describes_itself_falsely_is_reported_and_opens_nothing(sites: Sites, description: bytes) -> None:
    server, client = sites.add(SERVER), sites.add(ROBOT, imports=[SWITCH])
    held = sites.held(server.member, sites.config([SWITCH], []))
    server.member.serve(next(iter(held)), description)
    sites.world.network.send_pending(SERVER)
    caller = Client(client.graph)
    sites.run(5)
    assert not caller.sees_server()
    assert client.faults == {"other-type": 1}


def test_a_client_that_says_it_is_something_else_is_refused_with_a_reason(sites: Sites) -> None:
    server, client = sites.add(SERVER, expose=[SWITCH]), sites.add(ROBOT, imports=[SWITCH])
    local, caller = LocalServer(server.graph), Client(client.graph)
    assert sites.run(3, caller.sees_server)
    other = replace(SERVICE, request=known.channel(known.IMAGE))
    client.stream.describe(Exchange("json", (other,)).to_cbor())
    sites.run(1)
    caller.call(switch(on=True))
    assert sites.run(1, lambda: len(caller.outcomes) == 1)
    assert isinstance(caller.outcomes[0], str)
    assert local.asked == 0


def test_a_graph_that_refuses_a_publisher_is_reported_once_until_it_accepts_it(
    sites: Sites, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    robot, server = sites.add(ROBOT, expose=[CHATTER, OTHER]), sites.add(SERVER)
    with monkeypatch.context() as patch:
        advertise = server.endpoint.advertise

        def refuse(channel: Channel) -> int:
            if channel.topic == "/chatter":
                raise LocalError("a local publisher has another definition")
            return advertise(channel)

        patch.setattr(type(server.endpoint), "advertise", lambda _, channel: refuse(channel))
        sites.reload(server, imports=[CHATTER, OTHER])
        ears = Ear(server.graph, "/chatter"), Ear(server.graph, "/other")
        talkers = [robot.graph.publish("/talker", rule, STRING) for rule in ("/chatter", "/other")]
        for number in range(10):
            Ear(server.graph, f"/unrelated{number}")
            sites.run(0.5)
        for talker in talkers:
            talker.publish(string("hello"))
        sites.run(1)
        assert [ear.texts for ear in ears] == [[], ["hello"]]
        assert len(caplog.messages) == 1
        assert caplog.messages[0].startswith("/chatter: ")
    Ear(server.graph, "/unrelated")
    assert sites.run(2, robot.is_read)
    talkers[0].publish(string("hello"))
    assert sites.run(1, lambda: ears[0].texts == ["hello"])
