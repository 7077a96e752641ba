"""Message definitions: parsed forms, bounds and refused texts."""

from __future__ import annotations

import pytest

from proxy.serial.schema import Array, DefinitionError, Number, Record, Sequence, Text, UnparsedError, parse

RULE = "=" * 80 + "\n"


def fields(text: str, ros: int = 2, definition_format: str = "msg") -> dict[str, object]:
    return dict(parse("a/msg/B", text, definition_format, ros).fields)


def test_bounds_do_not_change_the_form() -> None:
    assert fields("string<=5 a\nint32[<=3] b\nint32[3] c\n") == {
        "a": Text(),
        "b": Sequence(Number("i")),
        "c": Array(Number("i"), 3),
    }


def test_wide_strings_are_known_in_every_place() -> None:
    text = 'wstring a\nwstring<=5 b\nwstring[] c\nwstring<=5[<=2] d\nwstring e "hello"\nwstring KEY="x"\n'
    wide = Text(wide=True)
    assert fields(text) == {"a": wide, "b": wide, "c": Sequence(wide), "d": Sequence(wide), "e": wide}


def test_a_byte_is_signed_in_ros_1_alone() -> None:
    assert fields("byte a\n", ros=1)["a"] == Number("b", octet=True)
    assert fields("byte a\n", ros=2)["a"] == Number("B", octet=True)


def test_time_is_unsigned_in_ros_1_and_signed_in_ros_2() -> None:
    for ros, code in ((1, "I"), (2, "i")):
        time = fields("time stamp\n", ros)["stamp"]
        assert isinstance(time, Record)
        assert time.fields == (("sec", Number(code)), ("nanosec", Number("I")))


def test_a_ros_1_header_keeps_its_sequence_number() -> None:
    text = f"Header header\n{RULE}MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    header = fields(text, ros=1)["header"]
    assert isinstance(header, Record)
    assert header.fields[0] == ("seq", Number("I"))


def test_idl_is_read_too() -> None:
    section = "module a { module msg { struct B { sequence<octet> data; wstring name; boolean flag; }; }; };\n"
    assert fields(f"{RULE}IDL: a/msg/B\n{section}", definition_format="idl") == {
        "data": Sequence(Number("B", octet=True)),
        "name": Text(wide=True),
        "flag": Number("?"),
    }


def test_lines_may_end_as_on_windows() -> None:
    assert fields("int32 a\r\nint32 b\r\n").keys() == {"a", "b"}


def test_a_type_within_itself_is_refused() -> None:
    with pytest.raises(DefinitionError, match="nested in itself"):
        fields(f"C c\n{RULE}MSG: a/C\nB b\n")


def test_a_chain_of_types_too_deep_is_refused() -> None:
    links = "".join(f"{RULE}MSG: a/T{number}\nT{number + 1} t\n" for number in range(100))
    with pytest.raises(DefinitionError, match="too deep"):
        fields(f"T0 t\n{links}")


def test_a_type_that_is_not_there_is_refused() -> None:
    with pytest.raises(DefinitionError, match="a/msg/C"):
        fields("C c\n")


def test_a_text_that_is_no_definition_is_recognised() -> None:
    with pytest.raises(UnparsedError):
        fields("int32 a\n---\nint32 b\n")
    with pytest.raises(UnparsedError):
        fields("module {", definition_format="idl")


def test_no_definition_is_refused() -> None:
    with pytest.raises(DefinitionError, match="no definition"):
        fields("", definition_format="")


@pytest.mark.parametrize("type_name", ["std_srvs/srv/SetBool_Request", "test_msgs/action/Fibonacci_SendGoal_Response"])
def test_halves_of_services_and_actions_are_types_like_any_other(type_name: str) -> None:
    assert [name for name, _ in parse(type_name, "bool data\n", "msg", 2).fields] == ["data"]


def test_a_definition_that_grows_without_end_is_refused() -> None:
    rule = "=" * 80 + "\n"
    levels = [f"MSG: a/L{n}\nL{n + 1} x\nL{n + 1} y\n" for n in range(1, 20)]
    text = "L1 x\nL1 y\n" + "".join(rule + level for level in [*levels, "MSG: a/L20\nuint8 z\n"])
    with pytest.raises(DefinitionError, match="more than"):
        parse("a/msg/Top", text, "msg", 1)
