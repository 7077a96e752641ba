"""Goals of rosbridge clients: what reaches the action's server, and what its client hears."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from typing import Final

import pytest

from gdp_extensions.doors.core.rosbridge_goals import GOALS_MAX
from proxy.bridge.core.delegated_rules import rules_of
from proxy.endpoints.core.endpoint import RequestReceived
from proxy.serial.channel import Service
from proxy.serial.rosbridge_json import RosbridgeCodec
from tests.gdp_extensions.doors.fibonacci import FEEDBACK, FIBONACCI, ID, RULE, SERVICES, TIME
from tests.gdp_extensions.doors.rights import goal_id
from tests.gdp_extensions.doors.test_rosbridge import Site
from tests.proxy.bridge import known

AT: Final = "/fibonacci/_action/"
UUID: Final = {"uuid": list(goal_id())}
GOAL: Final = {"op": "send_action_goal", "action": "/fibonacci", "action_type": FIBONACCI, "args": {"order": 2}}


class ActionSite(Site):
    """A hub with the server of an action and one session."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for handle, (part, each) in enumerate(SERVICES.items(), 1):
            self.hub.offer_service(handle, Service(AT + part, each.type_name, each.hash, each.request, each.response))
        self.hub.offer_topic(9, replace(FEEDBACK, topic=f"{AT}feedback"))

    def requests(self) -> list[tuple[str, object]]:
        """Return what the server was asked, by part."""
        asked = [each for each in self.events if isinstance(each, RequestReceived)]
        parts = [(part, each.request) for part, each in SERVICES.items()]
        named = [(*parts[each.handle - 1], each.raw) for each in asked]
        return [(part, json.loads(RosbridgeCodec(request).to_json(raw))) for part, request, raw in named]

    def answer(self, part: str, tree: object) -> list[dict[str, object]]:
        """Answer the last request of the server; return what the client hears."""
        request = [each for each in self.events if isinstance(each, RequestReceived)][-1]
        self.hub.pass_answer(request.ticket, RosbridgeCodec(SERVICES[part].response).to_raw(tree))
        return self.heard()

    def feed(self, *sequence: int, uuid: object = UUID) -> None:
        tree = {"goal_id": uuid, "feedback": {"sequence": list(sequence)}}
        self.hub.pass_message(9, 5, RosbridgeCodec(FEEDBACK).to_raw(tree))


def test_a_goal_has_feedback_and_then_its_result() -> None:
    site = ActionSite()
    assert site.say(**GOAL, id="g", feedback=True) == []
    assert site.answer("send_goal", {"accepted": True}) == []
    site.feed(0, 1)
    site.feed(7, uuid={"uuid": [9] * 16})  # of another client
    uuid = {"uuid": base64.b64encode(goal_id()).decode()}
    assert site.requests() == [
        ("send_goal", {"goal_id": uuid, "goal": {"order": 2}}),
        ("get_result", {"goal_id": uuid}),
    ]
    heard = site.answer("get_result", {"status": 4, "result": {"sequence": [0, 1, 1]}})
    same = {"action": "/fibonacci", "id": "g"}
    assert heard == [
        {"op": "action_feedback", **same, "values": {"sequence": [0, 1]}},
        {"op": "action_result", **same, "values": {"sequence": [0, 1, 1]}, "status": 4, "result": True},
    ]
    site.feed(0, 1, 1)
    assert site.heard() == []


def test_a_goal_without_feedback_is_cancelled_by_its_id() -> None:
    site = ActionSite()
    site.say(**GOAL, id="g")
    site.answer("send_goal", {"accepted": True})
    site.feed(0, 1)
    assert site.say(op="cancel_action_goal", action="/fibonacci", id="g") == []
    part, tree = site.requests()[-1]
    assert (part, "goal_info" in str(tree)) == ("cancel_goal", True)
    assert site.answer("cancel_goal", {"return_code": 0}) == []
    request = next(each for each in site.events if isinstance(each, RequestReceived) and each.handle == 3)
    site.hub.pass_answer(request.ticket, RosbridgeCodec(SERVICES["get_result"].response).to_raw({"status": 5}))
    (heard,) = site.heard()
    assert (heard["op"], heard["status"], heard["result"]) == ("action_result", 5, True)


def test_actions_with_a_server_and_definitions_of_topics_are_listed() -> None:
    site = ActionSite()
    (heard,) = site.say(op="call_service", service="/rosapi/action_servers")
    assert heard["values"] == {"action_servers": ["/fibonacci"]}
    (heard,) = site.say(op="call_service", service="/rosapi/topics_and_raw_types")
    assert heard["values"] == {
        "topics": [f"{AT}feedback"],
        "types": [FEEDBACK.type_name],
        "typedefs_full_text": [FEEDBACK.definition],
    }


def test_a_stamp_of_a_goal_may_be_the_present_time() -> None:
    site = Site()
    fields = f"unique_identifier_msgs/UUID goal_id\na/Go_Goal goal\n{ID}"
    text = f"{fields}{RULE}\nMSG: a/Go_Goal\nbuiltin_interfaces/Time at\n{TIME}"
    go = known.service("a/action/Go_SendGoal", text, "bool accepted\n")
    site.hub.offer_service(1, replace(go, name="/go/_action/send_goal"))
    assert site.say(op="send_action_goal", action="/go", action_type="a/Go", args={"at": "now"}) == []
    (request,) = [each for each in site.events if isinstance(each, RequestReceived)]
    assert json.loads(RosbridgeCodec(go.request).to_json(request.raw))["goal"] == {"at": {"sec": 0, "nanosec": 5}}


@pytest.mark.parametrize("fields", [{"id": "other"}, {}])
def test_a_goal_that_is_not_under_way_cannot_be_cancelled(fields: dict[str, object]) -> None:
    site = ActionSite()
    site.say(**GOAL, id="g")
    (heard,) = site.say(op="cancel_action_goal", action="/fibonacci", **fields)
    assert "no goal with this id is under way" in str(heard["msg"])


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"action": "/other"}, "/other: no server is reachable"),
        ({"action_type": "a/B"}, f"its type is {FIBONACCI}"),
        ({"args": {"size": 1}}, "there is no field size"),
        ({"args": [2]}, "an object was expected"),
    ],
)
def test_a_goal_that_cannot_be_sent_ends_with_the_reason(fields: dict[str, object], reason: str) -> None:
    site = ActionSite()
    (heard,) = site.say(**GOAL | fields, id=5)
    assert (heard["op"], heard["result"], heard["status"], heard["id"]) == ("action_result", False, 0, 5)
    assert reason in str(heard["values"])
    assert site.requests() == []


def test_a_missing_right_names_the_command() -> None:
    site = Site(rules_of([]))
    (heard,) = site.say(**GOAL, id=5)
    assert "'gdp delegate name --right call --kind action --name /fibonacci " in str(heard["values"])


def test_a_rejected_goal_and_one_whose_server_goes_end_with_the_reason() -> None:
    site = ActionSite()
    site.say(**GOAL, id=1)
    (heard,) = site.answer("send_goal", {"accepted": False})
    assert (heard["result"], heard["values"]) == (False, "/fibonacci: its server rejected the goal")
    site.say(**GOAL, id=2)
    site.answer("send_goal", {"accepted": True})
    site.hub.close(3, site.now_s)
    (heard,) = site.heard()
    assert (heard["id"], heard["result"]) == (2, False)
    assert "its last server is gone" in str(heard["values"])


def test_goals_of_a_client_are_bounded_and_their_ids_differ() -> None:
    site = ActionSite()
    said = [site.say(**GOAL, id=number) for number in range(GOALS_MAX + 1)]
    assert said[:-1] == [[]] * GOALS_MAX
    assert f"more than {GOALS_MAX} goals are under way" in str(said[-1])
    site = ActionSite()
    site.say(**GOAL, id=1)
    assert "a goal with this id is under way" in str(site.say(**GOAL, id=1))
