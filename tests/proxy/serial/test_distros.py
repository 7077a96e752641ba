"""Messages between distributions of ROS 2 whose definitions differ, in both directions, by their own definitions."""

from __future__ import annotations

import re
import sys
from dataclasses import fields
from functools import cache
from itertools import permutations
from pathlib import Path
from random import Random
from typing import Any, Final

import pytest
from numpy.testing import assert_array_equal
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from proxy.serial.channel import Channel
from proxy.serial.converter import MessageConverter
from proxy.serial.schema import DefinitionError
from tests.proxy.endpoints.ros2_net import needs
from tests.proxy.serial.drawn import drawn_message, wire_of

DISTROS: Final = (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED, Stores.ROS2_LYRICAL)
OWN: Final = "rmw_dds_common/"  # what a middleware says to itself


@cache
def store_of(distro: Stores) -> Typestore:
    return get_typestore(distro)


@cache
def channel(distro: Stores, type_name: str) -> Channel:
    return of_store(store_of(distro), distro, type_name)


def of_store(store: Typestore, distro: Stores, type_name: str) -> Channel:
    text, _ = store.generate_msgdef(type_name, 2)
    return Channel("", type_name, 2, hash=f"of {distro.value}", definition=text, definition_format="msg")


def custom(text: str, form: str = "a") -> Channel:
    return Channel("", "a/msg/Type", 2, hash=form, definition=text, definition_format="msg")


def shared(there: Stores, here: Stores) -> list[str]:
    both = store_of(there).fielddefs.keys() & store_of(here).fielddefs.keys()
    return sorted(name for name in both if not name.startswith(OWN))


def assert_kept(theirs: Any, ours: Any) -> None:
    """Compare the fields that both have; others here have a default."""
    if isinstance(theirs, list):
        assert len(theirs) == len(ours)
        for one, other in zip(theirs, ours, strict=True):
            assert_kept(one, other)
    elif hasattr(theirs, "__msgtype__"):
        names = {each.name for each in fields(theirs)} & {each.name for each in fields(ours)}
        for name in names:
            assert_kept(getattr(theirs, name), getattr(ours, name))
    else:
        assert_array_equal(theirs, ours)


@pytest.mark.parametrize(("there", "here"), list(permutations(DISTROS, 2)), ids=lambda each: each.value)
def test_every_common_message_arrives_with_all_that_both_distributions_know(there: Stores, here: Stores) -> None:
    names, differing = shared(there, here), 0
    for number, name in enumerate(names):
        source, target = channel(there, name), channel(here, name)
        if source.definition == target.definition:
            continue
        differing += 1
        message = drawn_message(store_of(there), name, Random(number), {})
        got = MessageConverter(source, target, is_strict=False).convert(wire_of(store_of(there), 2, message, name))
        assert_kept(message, store_of(here).deserialize_cdr(got, name))
    assert len(names) > 100
    assert differing or {there, here} <= {Stores.ROS2_JAZZY, Stores.ROS2_KILTED}


PARTS: Final = {".srv": ("Request", "Response"), ".action": ("Goal", "Result", "Feedback")}
EMPTY: Final = "uint8 structure_needs_at_least_one_member\n"


@cache
def with_parts(distro: Stores) -> tuple[Typestore, list[str]]:
    """Return a store with the parts of the services and actions of the installed wheels, and their names.

    Their own lines are those of Jazzy; what they contain is the distribution's, or they are left out.
    """
    store, names = get_typestore(distro), list[str]()
    for path in sorted((Path(sys.prefix) / "share").glob("*/*/*.*")):
        if path.suffix not in PARTS or (path.parts[-3] == "test_msgs" and path.suffix == ".srv"):
            continue
        texts = re.split(r"^---$", path.read_text(), flags=re.MULTILINE)
        for part, text in zip(PARTS[path.suffix], texts, strict=True):
            name = f"{path.parts[-3]}/msg/{path.stem}{part}"
            is_empty = not re.sub(r"#.*|\w+ \w+ *=.*", "", text).strip()
            found = get_types_from_msg(EMPTY if is_empty else text, name)
            needed = set(re.findall(r"'(\w+/msg/\w+)'", str(found[name])))
            if name not in names and needed <= store.fielddefs.keys():
                store.register(found)
                names.append(name)
    return store, names


@pytest.mark.parametrize(("there", "here"), list(permutations(DISTROS, 2)), ids=lambda each: each.value)
def test_services_and_actions_arrive_with_all_that_both_distributions_know(there: Stores, here: Stores) -> None:
    needs("std_srvs", "nav_msgs", "test_msgs")
    (theirs, names), (ours, known) = with_parts(there), with_parts(here)
    both = [each for each in names if each in known]
    for number, name in enumerate(both):
        source, target = (of_store(store, distro, name) for store, distro in ((theirs, there), (ours, here)))
        message = drawn_message(theirs, name, Random(number), {})
        got = MessageConverter(source, target, is_strict=False).convert(wire_of(theirs, 2, message, name))
        assert_kept(message, ours.deserialize_cdr(got, name))
    assert {"nav_msgs/msg/GetMapResponse", "sensor_msgs/msg/SetCameraInfoRequest", "std_srvs/msg/TriggerResponse"} <= {
        *both
    }
    assert len(both) > 40
    assert {"test_msgs/msg/FibonacciGoal", "test_msgs/msg/FibonacciResult"} <= {*both}


def test_range_differs_by_its_variance_alone() -> None:
    humble, jazzy = (channel(each, "sensor_msgs/msg/Range") for each in DISTROS[:2])
    assert MessageConverter(humble, jazzy, is_strict=False).differences == (
        "variance: not known there, has its default",
    )
    assert MessageConverter(jazzy, humble, is_strict=False).differences == ("variance: not known here, dropped",)
    with pytest.raises(DefinitionError, match="variance: nothing there, float32 here"):
        MessageConverter(humble, jazzy)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("float64 y 1.5\n", bytes(7) + b"\0\0\0\0\0\0\xf8\x3f"),
        ("int8 y -3\n", b"\xfd"),
        ("bool y true\n", b"\1"),
        ("uint8 y  # none\n", b"\0"),
        ('string y "hi"\n', b"\0\0\0\3\0\0\0hi\0"),
        ("string y 'a # b'\n", b"\0\0\0\6\0\0\0a # b\0"),
        ("int16[] y [1, -1]\n", b"\0\0\0\2\0\0\0\1\0\xff\xff"),
        ("int16[2] y [1, 2]\n", b"\0\1\0\2\0"),
        ("float32[40] y\n", bytes(3 + 160)),
        ("string[] y\n", bytes(3 + 4)),
        ("Pair y\n" + "=" * 80 + "\nMSG: a/Pair\nuint8 p 7\nuint8 q\n", b"\7\0"),
    ],
)
def test_a_missing_field_has_the_default_of_its_definition(field: str, value: bytes) -> None:
    converter = MessageConverter(custom("uint8 x\n"), custom(f"uint8 x\n{field}", "b"), is_strict=False)
    assert converter.convert(b"\0\1\0\0\5") == b"\0\1\0\0\5" + value


@pytest.mark.parametrize("field", ["uint8 y 300\n", "uint8 y hello\n", "int32 y [1]\n", "string y 1\n", "int8[] y 3\n"])
def test_a_default_that_is_none_is_refused(field: str) -> None:
    with pytest.raises(DefinitionError, match="y has a default that does not fit"):
        MessageConverter(custom("uint8 x\n"), custom(f"uint8 x\n{field}", "b"), is_strict=False)


def test_fields_in_another_order_find_each_other() -> None:
    converter = MessageConverter(custom("uint8 x\nuint8 y\n"), custom("uint8 y\nuint8 x\n", "b"), is_strict=False)
    assert converter.convert(b"\0\1\0\0\1\2") == b"\0\1\0\0\2\1"
    assert converter.differences == ("the type: its fields have another order there",)


def test_a_field_of_another_type_is_refused_whatever_the_rule_says() -> None:
    with pytest.raises(DefinitionError, match="x: int32 there, float64 here"):
        MessageConverter(custom("int32 x\n"), custom("float64 x\n", "b"), is_strict=False)
