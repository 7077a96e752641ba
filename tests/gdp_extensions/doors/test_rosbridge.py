"""rosbridge: JSON of messages, throttling, and sessions without a connection."""

from __future__ import annotations

import base64
import io
import itertools
import json
import math
import struct
from dataclasses import dataclass, field, replace

import cbor2
import pytest

from gdp.errors import GdpError, RemoteError
from gdp_extensions.doors.core.client_queue import ClientQueue, Pending
from gdp_extensions.doors.core.hub import Hub
from gdp_extensions.doors.core.rosbridge_session import RosbridgeSession
from gdp_extensions.doors.core.throttle import Throttle
from proxy.bridge.core.delegated_rules import DelegatedRules, rules_of
from proxy.endpoints.core.endpoint import Event, MessageReceived, RequestReceived, Role, TypeResolved
from proxy.endpoints.core.qos import default
from proxy.serial.rosbridge_json import RosbridgeCodec
from proxy.serial.standard_types import known_channel
from tests.gdp_extensions.doors.rights import Everything, goal_id
from tests.proxy.bridge import known

NUMBERS = known.custom("own_msgs/msg/Numbers", "float64 x\nfloat32[] y\nuint8[] octets\nint64 big\nbool on\nstring s\n")


@dataclass
class Site:
    """A hub with one session, and what leaves it."""

    rights: DelegatedRules = field(default_factory=Everything)
    now_s: float = 100.0
    events: list[Event] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.hub = Hub(self.events.append, lambda: self.rights, _known)
        self.session = RosbridgeSession(self.hub, 1, ClientQueue(), lambda: self.now_s, goal_id)
        self.hub.open(self.session)

    def say(self, **fields: object) -> list[dict[str, object]]:
        """Pass a message of the client; return what it is heard."""
        self.session.handle_message(json.dumps(fields), 5)
        return self.heard()

    def heard(self) -> list[dict[str, object]]:
        """Return what waits for the client."""
        found = list[dict[str, object]]()
        while (item := self.session.queue.pop()) is not None:
            text = self.session.encode(item) if isinstance(item, Pending) else item
            found.append(json.loads(text) if isinstance(text, str) else cbor2.loads(text))
        return found


def _known(topic: str, type_name: str):  # type: ignore[no-untyped-def]
    try:
        return known_channel(topic, type_name)
    except GdpError:
        return None


def test_a_message_becomes_rosbridge_json_and_back() -> None:
    codec = RosbridgeCodec(NUMBERS)
    sent = {"x": 1.5, "y": [1.0, None], "octets": [1, 2], "big": 1 << 60, "on": True, "s": "é"}
    back = json.loads(codec.to_json(codec.to_raw(sent)))
    assert back == {"x": 1.5, "y": [1.0, None], "octets": "AQI=", "big": 1 << 60, "on": True, "s": "é"}
    assert codec.to_raw(back) == codec.to_raw(sent)


def test_a_nan_and_infinities_are_null() -> None:
    codec = RosbridgeCodec(NUMBERS)
    raw = b"\0\1\0\0" + struct.pack("<d", math.inf) + codec.to_raw({})[12:]
    assert json.loads(codec.to_json(raw))["x"] is None


def test_fields_that_a_client_leaves_out_are_zero() -> None:
    codec = RosbridgeCodec(known_channel("/a", "geometry_msgs/msg/TwistStamped"))
    message = json.loads(codec.to_json(codec.to_raw({"twist": {"linear": {"x": 2}}})))
    assert message["twist"] == {"linear": {"x": 2.0, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}}
    assert message["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}


POSE = known_channel("/pose", "geometry_msgs/msg/PoseStamped")


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ({"stamp": {"sec": 5, "nanosec": 6}}, (5, 6)),
        ({"stamp": {"secs": 5, "nsecs": 6}, "seq": 9}, (5, 6)),
        ({"stamp": {"sec": 5, "secs": 7, "nsecs": 6}}, (5, 6)),
        ({"stamp": {"secs": 5}}, (5, 0)),
        ({"stamp": {}}, (0, 0)),
        ({"stamp": "now"}, (1_700_000_000, 250)),
        ({}, (1_700_000_000, 250)),
        (None, (0, 0)),
    ],
)
def test_stamps_are_read_as_rosbridge_suite_reads_them(header: object, expected: tuple[int, int]) -> None:
    codec = RosbridgeCodec(POSE)
    message = json.loads(
        codec.to_json(codec.to_raw({} if header is None else {"header": header}, 1_700_000_000 * 10**9 + 250))
    )
    assert tuple(message["header"]["stamp"].values()) == expected


def test_durations_and_stamps_within_lists_are_read_in_either_spelling() -> None:
    codec = RosbridgeCodec(known_channel("/plan", "trajectory_msgs/msg/JointTrajectory"))
    sent = {"points": [{"time_from_start": {"secs": 1, "nsecs": 2}}, {"time_from_start": {"sec": 3}}]}
    points = json.loads(codec.to_json(codec.to_raw(sent)))["points"]
    assert [each["time_from_start"] for each in points] == [{"sec": 1, "nanosec": 2}, {"sec": 3, "nanosec": 0}]


@pytest.mark.parametrize("stamp", ["then", "now ", 5, [], {"secs": "x"}, {"secs": 1 << 40}])
def test_a_stamp_that_is_none_is_refused(stamp: object) -> None:
    with pytest.raises(RemoteError):
        RosbridgeCodec(POSE).to_raw({"header": {"stamp": stamp}})


@pytest.mark.parametrize("tree", [[], {"z": 1}, {"x": "one"}, {"octets": "?"}, {"octets": [300]}, {"s": 5}, {"on": 2}])
def test_a_message_that_does_not_fit_is_refused(tree: object) -> None:
    with pytest.raises(RemoteError, match=r"own_msgs/msg/Numbers"):
        RosbridgeCodec(NUMBERS).to_raw(tree)


def test_an_empty_type_is_an_empty_object() -> None:
    codec = RosbridgeCodec(known_channel("/a", "std_msgs/msg/Empty"))
    assert codec.to_json(codec.to_raw({})) == b"{}"


def test_a_throttle_leaves_out_or_keeps_the_newest() -> None:
    plain, queued = Throttle(1.0, 0), Throttle(1.0, 2)
    for number, now_s in enumerate((0.0, 0.1, 0.2, 0.3)):
        assert plain.offer(number, b"", now_s) == queued.offer(number, b"", now_s) == (number == 0)
    assert plain.get_timer() is None
    assert queued.get_timer() == 1.0
    assert queued.poll(0.9) is None
    assert [queued.poll(now_s) for now_s in (1.0, 1.5, 2.0, 3.0)] == [(2, b""), None, (3, b""), None]
    assert plain.offer(9, b"", 1.0)


def test_a_subscription_gets_messages_by_name() -> None:
    site = Site()
    site.hub.offer_topic(1, known_channel("/chat", known.STRING))
    assert site.say(op="subscribe", topic="/chat", type="std_msgs/String") == []
    assert {(each.role, each.name, each.type_name) for each in site.hub.graph} == {
        (Role.SUBSCRIBES, "/chat", known.STRING)
    }
    site.hub.pass_message(1, 5, known.string("hello"))
    assert site.heard() == [{"op": "publish", "topic": "/chat", "msg": {"data": "hello"}}]
    site.say(op="unsubscribe", topic="/chat")
    assert not site.hub.graph


def test_names_are_relative_to_the_root_and_come_back_as_the_client_wrote_them() -> None:
    site = Site()
    site.hub.offer_topic(1, known_channel("/chat", known.STRING))
    site.say(op="subscribe", topic="chat")
    site.say(op="subscribe", topic="/chat")
    assert {each.name for each in site.hub.graph} == {"/chat"}
    site.hub.pass_message(1, 5, known.string("hello"))
    assert sorted(str(each["topic"]) for each in site.heard()) == ["/chat", "chat"]
    site.say(op="unsubscribe", topic="/chat")
    site.hub.pass_message(1, 6, known.string("again"))
    assert [each["topic"] for each in site.heard()] == ["chat"]
    site.say(op="unsubscribe", topic="chat")
    assert not site.hub.graph
    site.say(op="advertise", topic="out", type="std_msgs/String")
    assert {(each.role, each.name) for each in site.hub.graph} == {(Role.PUBLISHES, "/out")}
    assert site.say(op="publish", topic="/out", msg={"data": "x"}) == []
    site.say(op="unadvertise", topic="out")
    assert not site.hub.graph


def test_a_relative_name_of_a_service_is_called_and_answered_by_that_name() -> None:
    site = Site()
    site.hub.offer_topic(1, known_channel("/chat", known.STRING))
    site.hub.offer_service(4, replace(known.services()[known.SET_BOOL], name="/switch"))
    site.say(op="call_service", service="switch", args={"data": True})
    request = site.events[-1]
    assert isinstance(request, RequestReceived)
    site.hub.pass_answer(request.ticket, known.switched("done"))
    (heard,) = site.heard()
    assert (heard["service"], heard["result"]) == ("switch", True)
    (heard,) = site.say(op="call_service", service="rosapi/topics")
    assert (heard["service"], heard["values"]) == ("rosapi/topics", {"topics": ["/chat"], "types": [known.STRING]})
    (heard,) = site.say(op="call_service", service="rosapi/topic_type", args={"topic": "chat"})
    assert heard["values"] == {"type": known.STRING}


def test_a_subscription_may_come_before_its_topic() -> None:
    site = Site()
    site.say(op="subscribe", topic="/pair", id="a")
    assert not site.hub.graph  # its type is unknown
    site.hub.offer_topic(1, replace(NUMBERS, topic="/pair"))
    assert {each.type_name for each in site.hub.graph} == {NUMBERS.type_name}


def test_throttled_messages_come_when_their_time_has_come() -> None:
    site = Site()
    site.hub.offer_topic(1, known_channel("/chat", known.STRING))
    site.say(op="subscribe", topic="/chat", throttle_rate=500, queue_length=1)
    for text in "abc":
        site.hub.pass_message(1, 5, known.string(text))
    assert [each["msg"] for each in site.heard()] == [{"data": "a"}]
    assert site.hub.get_timer() == 100.5
    site.hub.handle_timer(100.5)
    assert [each["msg"] for each in site.heard()] == [{"data": "c"}]


def test_raw_bytes_are_had_as_cbor() -> None:
    site = Site()
    site.hub.offer_topic(1, known_channel("/chat", known.STRING))
    site.say(op="subscribe", topic="/chat", compression="cbor-raw")
    site.hub.pass_message(1, 3_000_000_005, known.string("hello"))
    message = {"secs": 3, "nsecs": 5, "bytes": known.string("hello")}
    assert site.heard() == [{"op": "publish", "topic": "/chat", "msg": message}]


def test_what_one_client_publishes_reaches_the_clients_of_the_same_door_that_read_it() -> None:
    site = Site()
    site.hub.offer_topic(1, known_channel("/chat", known.STRING))
    other = RosbridgeSession(site.hub, 2, ClientQueue(), lambda: site.now_s, goal_id)
    site.hub.open(other)
    site.say(op="subscribe", topic="/chat")
    other.handle_message(json.dumps({"op": "publish", "topic": "/chat", "msg": {"data": "hello"}}), 5)
    assert site.heard() == [{"op": "publish", "topic": "/chat", "msg": {"data": "hello"}}]
    assert site.say(op="publish", topic="/chat", msg={"data": "own"}) == [
        {"op": "publish", "topic": "/chat", "msg": {"data": "own"}}
    ]
    site.hub.take_topic(7, "/chat", known.STRING)
    sent = [known.text_of(each.raw) for each in site.events if isinstance(each, MessageReceived)]
    assert sent == ["hello", "own"]


def test_the_time_is_had_in_the_spelling_of_either_ros() -> None:
    (heard,) = Site().say(op="call_service", service="/rosapi/get_time")
    assert heard["values"] == {"time": {"sec": 0, "nanosec": 5, "secs": 0, "nsecs": 5}}


def test_cbor_has_octets_as_bytes_and_numbers_as_typed_arrays() -> None:
    site = Site()
    site.hub.offer_topic(1, replace(NUMBERS, topic="/n"))
    site.say(op="subscribe", topic="/n", compression="cbor")
    sent = {"x": math.inf, "y": [1.0, 2.0], "octets": [1, 2], "big": 1 << 60, "on": True, "s": "é"}
    site.hub.pass_message(1, 5, RosbridgeCodec(NUMBERS).to_raw(sent))
    (heard,) = site.heard()
    typed = cbor2.CBORTag(85, struct.pack("<2f", 1.0, 2.0))  # RFC 8746: float32, little-endian
    assert heard == {"op": "publish", "topic": "/n", "msg": sent | {"y": typed, "octets": b"\1\2"}}


@pytest.mark.parametrize("size", [0, 1, 2, 3, 100, 5_000])
def test_png_has_the_text_in_its_pixels(size: int) -> None:
    image = pytest.importorskip("PIL.Image")
    site = Site()
    site.hub.offer_topic(1, known_channel("/chat", known.STRING))
    site.say(op="subscribe", topic="/chat", compression="png")
    site.hub.pass_message(1, 5, known.string("é" * size))
    (heard,) = site.heard()
    assert heard["op"] == "png"
    picture = image.open(io.BytesIO(base64.b64decode(str(heard["data"]))))
    assert (picture.format, picture.mode, picture.text) == ("PNG", "RGB", {})
    text = picture.tobytes().decode()
    assert json.loads(text) == {"op": "publish", "topic": "/chat", "msg": {"data": "é" * size}}


def test_a_late_subscription_gets_the_last_latched_message() -> None:
    site = Site()
    channel = replace(known_channel("/map", known.STRING), latched=True, qos=(default(latched=True, depth=1),))
    site.hub.offer_topic(1, channel)
    for text in ("old", "new"):
        site.hub.pass_message(1, 5, known.string(text))
    assert [each["msg"] for each in site.say(op="subscribe", topic="/map")] == [{"data": "new"}]


def test_what_a_client_publishes_waits_until_the_bridge_takes_it() -> None:
    site = Site()
    site.say(op="advertise", topic="/say", type="std_msgs/String", id="1")
    site.say(op="publish", topic="/say", msg={"data": "one"})
    site.hub.take_topic(7, "/say", known.STRING)
    site.say(op="publish", topic="/say", msg={"data": "two"})
    got = [each for each in site.events if isinstance(each, TypeResolved | MessageReceived)]
    assert isinstance(got[0], TypeResolved)
    assert [known.text_of(each.raw) for each in got[1:] if isinstance(each, MessageReceived)] == ["one", "two"]
    site.say(op="unadvertise", topic="/say", id="1")
    assert not site.hub.graph


@pytest.mark.parametrize(
    ("fields", "command"),
    [
        ({"op": "subscribe", "topic": "/a", "type": "std_msgs/String"}, "--right read --kind topic --name /a"),
        ({"op": "advertise", "topic": "/a", "type": "std_msgs/String"}, "--right publish --kind topic --name /a"),
        ({"op": "publish", "topic": "/a", "msg": {}}, "--right publish --kind topic --name /a"),
        ({"op": "call_service", "service": "/a"}, "--right call --kind service --name /a"),
    ],
)
def test_a_missing_right_is_an_error_that_names_the_command(fields: dict[str, object], command: str) -> None:
    site = Site(rules_of([]))
    (heard,) = site.say(**fields, id="x")
    assert heard["id"] == "x"
    assert f"'gdp delegate name {command}" in str(heard.get("msg") or heard["values"])
    assert not site.hub.graph


def test_a_service_is_called_by_name() -> None:
    site = Site()
    site.hub.offer_service(4, replace(known.services()[known.SET_BOOL], name="/switch"))
    for args in ({"data": True}, [True]):
        site.say(op="call_service", service="/switch", args=args, id="x")
        request = site.events[-1]
        assert isinstance(request, RequestReceived)
        assert (request.handle, request.raw) == (4, known.switch(on=True))
        site.hub.pass_answer(request.ticket, known.switched("done"))
        values = {"success": True, "message": "done"}
        assert site.heard() == [
            {"op": "service_response", "service": "/switch", "values": values, "result": True, "id": "x"}
        ]
    site.say(op="call_service", service="/switch", id="y")
    site.hub.close(4, site.now_s)
    (heard,) = site.heard()
    assert (heard["result"], heard["values"]) == (False, "/switch: its last server is gone")


def test_names_and_types_are_listed() -> None:
    site = Site()
    site.hub.offer_topic(1, known_channel("/chat", known.STRING))
    (heard,) = site.say(op="call_service", service="/rosapi/topics")
    assert heard["values"] == {"topics": ["/chat"], "types": [known.STRING]}
    (heard,) = site.say(op="call_service", service="/rosapi/topic_type", args={"topic": "/chat"})
    assert heard["values"] == {"type": known.STRING}
    (heard,) = site.say(op="call_service", service="/rosapi/nodes")
    assert heard["result"] is False


@pytest.mark.parametrize("data", ["{", "[]", "{}", '{"op":"fragment"}'])
def test_another_message_is_refused(data: str) -> None:
    with pytest.raises(RemoteError):
        Site().session.handle_message(data, 0)


@pytest.mark.parametrize(
    "fields",
    [
        {"op": "subscribe"},
        {"op": "subscribe", "topic": 5},
        {"op": "subscribe", "topic": "/a", "throttle_rate": -1},
        {"op": "subscribe", "topic": "/a", "compression": "zip"},
        {"op": "unsubscribe", "topic": "/a"},
        {"op": "unadvertise", "topic": "/a"},
        {"op": "set_level", "level": "loud"},
        {"op": "publish", "topic": "/a", "type": "own_msgs/Unknown", "msg": {}},
    ],
)
def test_a_wrong_operation_is_heard(fields: dict[str, object]) -> None:
    (heard,) = Site().say(**fields)
    assert (heard["op"], heard["level"]) == ("status", "error")


def test_a_level_hides_what_is_less_severe() -> None:
    site = Site()
    site.session.tell_dropped(3)
    assert site.heard() == []
    site.say(op="set_level", level="warning")
    site.session.tell_dropped(3)
    assert "reads too slowly" in str(site.heard())
    site.say(op="set_level", level="none")
    assert list(itertools.chain(site.say(op="unsubscribe", topic="/a"))) == []
