"""Content of live nodes' messages, in the shape of either ROS."""

from __future__ import annotations

from array import array
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest

from ring.nodes.content import TALKS, Mark, Talk, digest, lamp_says, take_small_picture

NOW_NS = 1_700_000_000_123_456_789


class _Shown:
    """Message of either ROS, by its fields in order."""

    def __init__(self, ros: int, **fields: object) -> None:
        self.__dict__.update(fields)
        names = [*(["seq"] if ros == 1 and "frame_id" in fields else []), *fields]
        if ros == 1:
            self.__dict__["__slots__"] = names
            self.seq = id(self)
        else:
            self.get_fields_and_field_types = lambda: dict.fromkeys(names, "?")


def _stamp(ros: int) -> _Shown:
    return _Shown(1, secs=0, nsecs=0) if ros == 1 else _Shown(2, sec=0, nanosec=0)


def _header(ros: int) -> _Shown:
    return _Shown(ros, stamp=_stamp(ros), frame_id="")


def _message(talk: Talk, ros: int) -> _Shown:
    if talk.node == "talker":
        return _Shown(ros, data="")
    if talk.node == "camera":
        fields = dict.fromkeys(("height", "width", "encoding", "is_bigendian", "step", "data"), 0)
        return _Shown(ros, header=_header(ros), **fields)
    origin = _Shown(ros, position=_Shown(ros, x=0.0), orientation=_Shown(ros, w=0.0))
    info = _Shown(ros, map_load_time=_stamp(ros), resolution=0.0, width=0, height=0, origin=origin)
    return _Shown(ros, header=_header(ros), info=info, data=[])


def _fit(ros: int, values: array[int]) -> object:
    if ros == 2:
        return values
    return values.tobytes() if values.typecode == "B" else values.tolist()


def said(talk: Talk, number: int, ros: int = 2, now_ns: int = NOW_NS) -> _Shown:
    message = _message(talk, ros)
    talk.fill(message, number, now_ns, lambda values: _fit(ros, values))
    return message


@pytest.fixture(params=TALKS, ids=[talk.node for talk in TALKS])
def talk(request: pytest.FixtureRequest) -> Talk:
    found: Talk = request.param
    return found


def test_the_same_content_has_one_digest_in_both_ros(talk: Talk) -> None:
    assert digest(said(talk, 7, ros=1)) == digest(said(talk, 7, ros=2))


def test_no_message_is_like_another(talk: Talk) -> None:
    digests = {digest(said(talk, number, now_ns=NOW_NS + number // 3)) for number in range(1, 40)}
    assert len(digests) == 39


@pytest.mark.parametrize("ros", [1, 2])
def test_a_listener_reads_when_a_message_was_said(talk: Talk, ros: int) -> None:
    mark = talk.read(said(talk, 5, ros))
    assert mark.stamp_ns == NOW_NS
    assert mark.number == (1 if talk.latched else 5)


def test_a_message_is_read_as_its_mark() -> None:
    for talk in TALKS:
        if not talk.latched:
            assert talk.read(said(talk, 0)) == Mark(0, NOW_NS)


def test_a_changed_byte_changes_the_digest() -> None:
    camera = next(talk for talk in TALKS if talk.node == "camera")
    whole, torn = said(camera, 3), said(camera, 3)
    pixels = vars(torn)["data"]
    pixels[-1] ^= 1
    assert digest(whole) != digest(torn)


def test_lists_of_other_cuts_have_other_digests() -> None:
    one, other = (SimpleNamespace(__slots__=("a", "b"), a=a, b=b) for a, b in (([1], [2, 3]), ([1, 2], [3])))
    assert digest(one) != digest(other)


def test_a_lamp_says_its_state_and_how_often_it_was_switched() -> None:
    assert lamp_says(3, on=True) == "on, switched 3 times"


@pytest.mark.parametrize("ros", [1, 2])
def test_a_small_picture_has_its_number_its_time_and_only_the_first_rows(ros: int) -> None:
    (camera,) = (talk for talk in TALKS if talk.node == "camera")
    small = replace(camera, fill=partial(take_small_picture, 10))
    message, whole = (vars(said(each, 7, ros=ros)) for each in (small, camera))
    assert small.read(SimpleNamespace(**message)) == Mark(7, NOW_NS)
    size = 10 * message["step"]
    assert message["height"] == 10
    assert bytes(message["data"]) == bytes(whole["data"][:size])
    assert len(message["data"]) == size
