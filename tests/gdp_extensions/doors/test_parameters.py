"""Parameters of nodes for Foxglove, through their services."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from gdp.errors import RemoteError
from gdp_extensions.doors.core.client_queue import ClientQueue
from gdp_extensions.doors.core.foxglove_session import FoxgloveSession
from gdp_extensions.doors.core.hub import Hub
from gdp_extensions.doors.core.parameters import GET, LIST, SET, from_value, node_and_name, to_value
from proxy.bridge.core.delegated_rules import DelegatedRules, rules_of
from proxy.endpoints.core.endpoint import Event, RequestReceived
from proxy.serial.channel import Service
from proxy.serial.rosbridge_json import RosbridgeCodec
from tests.gdp_extensions.doors.rights import Everything
from tests.proxy.bridge import known

_LINE = "=" * 80 + "\n"
_VALUE = (
    f"{_LINE}MSG: rcl_interfaces/ParameterValue\nuint8 type\nbool bool_value\nint64 integer_value\n"
    "float64 double_value\nstring string_value\nbyte[] byte_array_value\nbool[] bool_array_value\n"
    "int64[] integer_array_value\nfloat64[] double_array_value\nstring[] string_array_value\n"
)
_PARAMETER = f"{_LINE}MSG: rcl_interfaces/Parameter\nstring name\nrcl_interfaces/ParameterValue value\n"
_RESULT = f"{_LINE}MSG: rcl_interfaces/SetParametersResult\nbool successful\nstring reason\n"
_NAMES = f"{_LINE}MSG: rcl_interfaces/ListParametersResult\nstring[] names\nstring[] prefixes\n"
SERVICES = {
    GET: ("string[] names\n", f"rcl_interfaces/ParameterValue[] values\n{_VALUE}"),
    LIST: ("string[] prefixes\nuint64 depth\n", f"rcl_interfaces/ListParametersResult result\n{_NAMES}"),
    SET: (
        f"rcl_interfaces/Parameter[] parameters\n{_PARAMETER}{_VALUE}",
        f"rcl_interfaces/SetParametersResult[] results\n{_RESULT}",
    ),
}


def service(node: str, what: tuple[str, str]) -> Service:
    request, response = (
        known.custom(f"{what[1]}_{half}", text)
        for half, text in zip(("Request", "Response"), SERVICES[what], strict=True)
    )
    return Service(f"{node}/{what[0]}", what[1], "", request, response)


class Node:
    """A node with parameters behind a hub, and a client."""

    def __init__(self, rights: DelegatedRules | None = None) -> None:
        self.values: dict[str, dict[str, object]] = {
            "gain": {"type": 3, "double_value": 2.0},
            "names": {"type": 9, "string_array_value": ["a"]},
        }
        self.events: list[Event] = []
        self.hub = Hub(self.events.append, lambda: rights or Everything(), lambda topic, type_name: None)
        self.session = FoxgloveSession(self.hub, 1, "test", ClientQueue())
        self.hub.open(self.session)
        self.heard()

    def serve(self, *listed: tuple[str, str]) -> None:
        self.services = dict(enumerate((service("/arm", each) for each in listed), 1))
        for handle, each in self.services.items():
            self.hub.offer_service(handle, each)
        self.heard()

    def say(self, **fields: object) -> list[dict[str, object]]:
        """Pass a message of the client, and answer requests, until nothing happens any more."""
        self.session.handle_message(json.dumps(fields), 0)
        while self.events:
            event = self.events.pop(0)
            if isinstance(event, RequestReceived):
                self._answer(event)
        return self.heard()

    def heard(self) -> list[dict[str, object]]:
        found = []
        while isinstance(item := self.session.queue.pop(), str):
            found.append(json.loads(item))
        return found

    def _answer(self, event: RequestReceived) -> None:
        each = self.services[event.handle]
        asked = json.loads(RosbridgeCodec(each.request).to_json(event.raw))
        result: dict[str, object]
        if each.type_name == LIST[1]:
            result = {"result": {"names": list(self.values)}}
        elif each.type_name == GET[1]:
            result = {"values": [self.values.get(name, {"type": 0}) for name in asked["names"]]}
        else:
            result = {"results": []}
            outcomes = []
            for parameter in asked["parameters"]:
                known_here = parameter["name"] in self.values
                outcomes.append({"successful": known_here, "reason": "" if known_here else "not declared"})
                if known_here:
                    self.values[parameter["name"]] = parameter["value"]
            result = {"results": outcomes}
        self.hub.pass_answer(event.ticket, RosbridgeCodec(each.response).to_raw(result))


def test_all_parameters_are_read() -> None:
    node = Node()
    node.serve(GET, LIST)
    (heard,) = node.say(op="getParameters", parameterNames=[], id="1")
    assert heard == {
        "op": "parameterValues",
        "id": "1",
        "parameters": [
            {"name": "/arm.gain", "value": 2.0, "type": "float64"},
            {"name": "/arm.names", "value": ["a"]},
        ],
    }


def test_a_parameter_is_set_and_heard() -> None:
    node = Node()
    node.serve(GET, SET)
    (heard,) = node.say(op="setParameters", parameters=[{"name": "/arm.gain", "value": 3, "type": "float64"}], id="2")
    assert heard["parameters"] == [{"name": "/arm.gain", "value": 3.0, "type": "float64"}]
    (wrong,) = node.say(op="setParameters", parameters=[{"name": "/arm.other", "value": True}])
    assert wrong["message"] == "/arm.other was not set: not declared"


def test_without_the_right_the_command_is_heard() -> None:
    node = Node(rules_of([]))
    wrong, values = node.say(op="getParameters", parameterNames=["/arm.gain"], id="1")
    assert "--right call --kind service --name /arm/get_parameters" in str(wrong["message"])
    assert values["parameters"] == []
    assert node.say(op="getParameters", parameterNames=[], id="2") == [
        {"op": "parameterValues", "parameters": [], "id": "2"}
    ]


@pytest.mark.parametrize(
    ("value", "type_name", "kind"),
    [
        (True, None, 1),
        (1, None, 2),
        (1, "float64", 3),
        (1.5, None, 3),
        ("a", None, 4),
        ("AQI=", "byte_array", 5),
        ([True], None, 6),
        ([1, 2], None, 7),
        ([1, 2], "float64_array", 8),
        ([1, 2.5], None, 8),
        (["a"], None, 9),
    ],
)
def test_a_value_crosses_both_ways(value: object, type_name: str | None, kind: int) -> None:
    there = to_value({"name": "/arm.p", "value": value, "type": type_name})
    assert there["type"] == kind
    codec = RosbridgeCodec(service("/arm", SET).request)
    request = json.loads(codec.to_json(codec.to_raw({"parameters": [{"name": "p", "value": there}]})))
    back = from_value("/arm.p", request["parameters"][0]["value"])
    assert back is not None
    assert back["value"] == value


@pytest.mark.parametrize("value", [None, {}, [1, "a"], [[1]]])
def test_another_value_is_refused(value: object) -> None:
    with pytest.raises(RemoteError):
        to_value({"name": "/arm.p", "value": value})


@pytest.mark.parametrize("name", ["arm.gain", "/arm", "/arm.", ""])
def test_another_name_is_refused(name: str) -> None:
    with pytest.raises(RemoteError):
        node_and_name(name)


def test_services_of_one_name_and_another_type_are_not_asked() -> None:
    node = Node()
    node.hub.offer_service(9, replace(service("/arm", GET), type_name="own_msgs/srv/Get"))
    node.heard()
    wrong, _ = node.say(op="getParameters", parameterNames=["/arm.gain"])
    assert wrong["message"] == "/arm/get_parameters: no server is reachable"
