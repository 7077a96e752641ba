"""Message texts: constants, annotations, names of other types, and refused texts."""

from __future__ import annotations

import pytest
from rosbags.interfaces import Nodetype

from proxy.serial.msg_text import parse_msg

RULE = "=" * 80


def constant(line: str) -> tuple[str, str, object]:
    """Return name, type and value of the only constant."""
    ((name, kind, value),) = parse_msg(line, "a/msg/B")["a/msg/B"][0]
    return name, kind, value


@pytest.mark.parametrize(
    ("line", "kind", "value"),
    [
        ("int32 X=-12 # why", "int32", -12),
        ("int32 X=0x1F", "int32", 31),
        ("uint8 X=0b101", "uint8", 5),
        ("uint8 X=017", "uint8", 15),
        ("uint8 X=089", "uint8", 89),
        ("float64 X=.5", "float64", 0.5),
        ("float64 X=1e3", "float64", 1000.0),
        ("bool X=True", "bool", True),
        ("bool X=false", "bool", False),
        ("string X='it\\'s' # why", "string", "it\\'s"),
        ('string X="a" and more', "string", '"a" and more'),
        ("string X=plain text", "string", "plain text"),
        ("string X='no end", "string", "'no end"),
    ],
)
def test_a_constant_has_the_value_that_its_line_states(line: str, kind: str, value: object) -> None:
    assert constant(line) == ("X", kind, value)


@pytest.mark.parametrize(
    ("word", "full"),
    [
        ("Header", "std_msgs/msg/Header"),
        ("time", "builtin_interfaces/msg/Time"),
        ("C", "a/msg/C"),
        ("d/D", "d/msg/D"),
        ("d/action/D_Goal", "d/action/D_Goal"),
    ],
)
def test_another_type_is_known_by_its_full_name(word: str, full: str) -> None:
    assert parse_msg(f"{word} x", "a/msg/B")["a/msg/B"][1] == [("x", (Nodetype.NAME, full))]


def test_annotations_and_comments_are_left_out() -> None:
    found = parse_msg("# comment\n@optional\n@key int32 x # comment\n\n  # another", "a/msg/B")
    assert found["a/msg/B"] == ([], [("x", (Nodetype.BASE, ("int32", 0)))])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("int32", "neither a field nor a constant"),
        ("int32 x+", "not the name of a field"),
        ("int32 X=", "a constant without a value"),
        ("int32 X=# why", "a constant without a value"),
        ("C X=1", "a constant of such a type"),
        ("int32[2] X=1", "a constant of such a type"),
        ("int32<=5 x", "a bound of what is no string"),
        ("int32[<=] x", "a bound without a number"),
        (f"int32[{'1' * 11}] x", "a number of 11 digits"),
        (f"{'c' * 257} x", "a field's type of 257 characters"),
        ("===\nMSG: a/C", "not the beginning of a used type"),
        (f"{RULE}\nC", "not the beginning of a used type"),
        (f"{RULE}\nMSG: a/{'C' * 255}", "a type's name of 257 characters"),
        ("".join(f"int32[{size}] x{size}\n" for size in range(257)), "more than 256 kinds of fields in one type"),
        ("".join(f"{RULE}\nMSG: a/C{number}\n" for number in range(1_024)), "more than 1024 types"),
    ],
)
def test_a_text_that_is_no_definition_is_refused_with_the_reason(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse_msg(text, "a/msg/B")
