"""Rows of names, their JSON form, and the rates between two answers of a node."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gdp.errors import RemoteError
from gdp.management.running_nodes import NodeTopics, RunningNode
from gdp.management.topic_rates import rated_rows
from gdp.names import Name
from gdp.state.control_protocol import Response, encode_response
from gdp.state.topic_rows import ROWS_MAX, Direction, TopicRow, rows_from_fields, rows_to_fields

NAME = Name(bytes(range(32)))
PROXY = RunningNode(Path("/p.sock"), "proxy", Name(b"p" * 32))
SWITCH = RunningNode(Path("/s.sock"), "switch", Name(b"s" * 32))
ROW = TopicRow(
    name=NAME.to_text(), direction=Direction.OUT, topic="/scan", kind="topic", type="sensor_msgs/msg/LaserScan",
    messages=10, bytes=1_000, lost=1, late=0, publishers=1, readers=2,
)  # fmt: skip


def test_rows_survive_encoding() -> None:
    assert rows_from_fields(rows_to_fields([ROW], 7.5)) == (7.5, [ROW], 0)


def test_the_largest_answer_fits_into_one_response_and_keeps_the_busiest_names() -> None:
    long = replace(ROW, topic="/" + "a" * 200, type="b" * 60, rights="call, read, publish")
    fields = rows_to_fields([replace(long, messages=number) for number in range(ROWS_MAX + 5)], 0.0)
    encode_response(Response(fields))  # raises where it is too large
    _, rows, left_out = rows_from_fields(fields)
    assert (len(rows), left_out, rows[0].messages) == (ROWS_MAX, 5, ROWS_MAX + 4)


@pytest.mark.parametrize(
    "row", [None, {}, {"name": "x"}, {**ROW.to_fields(), "direction": "up"}, {**ROW.to_fields(), "bytes": "1"}]
)
def test_a_row_of_another_form_is_refused(row: object) -> None:
    with pytest.raises(RemoteError):
        rows_from_fields({"mono_s": 1.0, "topics": [row], "left_out": 0})


def test_a_rate_is_the_difference_of_two_answers() -> None:
    later = replace(ROW, messages=30, bytes=3_000, lost=4)
    (rated,) = rated_rows([NodeTopics(PROXY, 1.0, [ROW])], [NodeTopics(PROXY, 3.0, [later])])
    assert (rated.messages_s, rated.bits_s, rated.lost, rated.late) == (10.0, 8_000.0, 3, 0)
    assert rated.size_bytes == 100


def test_a_flow_that_began_again_has_no_rate() -> None:
    (rated,) = rated_rows(
        [NodeTopics(PROXY, 1.0, [ROW])], [NodeTopics(PROXY, 2.0, [replace(ROW, messages=2, bytes=9)])]
    )
    assert (rated.messages_s, rated.bits_s) == (None, None)


def test_a_switch_shows_the_ros_name_that_a_proxy_knows() -> None:
    through = TopicRow(name=NAME.to_text(), direction=Direction.THROUGH)
    stranger = TopicRow(name=Name(b"x" * 32).to_text(), direction=Direction.THROUGH)
    answers = [NodeTopics(PROXY, 1.0, [ROW]), NodeTopics(SWITCH, 1.0, [through, stranger])]
    assert [row.topic for row in rated_rows([], answers)] == ["/scan", "/scan", Name(b"x" * 32).short]
