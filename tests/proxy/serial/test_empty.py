"""Empty messages of any type, and responses with a reason."""

from __future__ import annotations

import json

from proxy.serial.channel import Channel
from proxy.serial.empty import NoAnswer
from proxy.serial.serializer import Serializer
from tests.proxy.bridge import known

NESTED = """bool yes
int8[3] three
uint8[4] octets
float64[] many
string[2] names
string<=4 short
wstring wide
Part[] parts
Part part
===
MSG: test_msgs/Part
uint16 number
string text
"""


def response(text: str) -> Channel:
    return known.custom("test_msgs/msg/Plan", text)


def test_every_field_of_an_empty_message_is_zero_or_of_no_length() -> None:
    channel = response(NESTED.replace("===", "=" * 80))
    raw = NoAnswer(channel).to_raw("late")
    body = Serializer(channel, "json").encode(raw)
    assert Serializer(channel, "json").decode(body) == raw
    assert json.loads(body) == {
        "yes": False,
        "three": [0, 0, 0],
        "octets": "AAAAAA==",
        "many": [],
        "names": ["", ""],
        "short": "",
        "wide": "",
        "parts": [],
        "part": {"number": 0, "text": ""},
    }


def test_the_reason_is_in_a_response_that_has_a_place_for_it() -> None:
    answer = NoAnswer(response("bool success\nstring message\n"))
    assert answer.says_reason
    assert answer.to_raw("late") == b"\0\1\0\0" + bytes(4) + b"\5\0\0\0late\0"


def test_a_success_that_is_no_truth_value_is_no_place_for_a_reason() -> None:
    assert not NoAnswer(response("uint8 success\nstring message\n")).says_reason
