"""Attacks with the definition of a topic's messages."""

from __future__ import annotations

import contextlib
import tracemalloc

import pytest

from gdp.crypto.cbor import encode
from gdp.errors import LocalError, RemoteError
from proxy.serial.channel import Channel, DefinitionFormat
from proxy.serial.schema import DefinitionError, parse
from proxy.serial.serializer import Serializer
from proxy.wire.message import CHANNELS_MAX, TopicDescription
from tests.attacks.work import lines_run

SIZE = 64 << 10
RULE = "=" * 80 + "\n"
STRUCT = "module a { module msg { struct B { "


def filled(unit: str, before: str = "", after: str = "") -> str:
    """Return 64 KiB of a repeated unit."""
    return before + unit * ((SIZE - len(before) - len(after)) // len(unit)) + after


def numbered(unit: str, before: str = "") -> str:
    """Return 64 KiB of lines that differ in a number."""
    lines, size = [before], len(before)
    while size + len(lines[-1]) + 8 < SIZE:
        lines.append(unit.format(len(lines)))
        size += len(lines[-1])
    return "".join(lines)


MSG = {
    "blank": filled("\n"),
    "blanks": filled(" \n"),
    "spaces": filled(" "),
    "comments": filled("#\n"),
    "comment": filled("x", "#"),
    "fields": numbered("bool a{0}\n"),
    "same": filled("bool a\n"),
    "constants": numbered("int8 A{0}=1\n"),
    "string": filled("x", 'string A="', '"\n'),
    "escapes": filled('\\"', 'string A="', '"\n'),
    "equals": filled("="),
    "rules": filled(RULE),
    "sections": filled(f"{RULE}MSG: a/C\n"),
    "bounded": filled("string<=5[<=3] a\n"),
    "slashes": filled("a/"),
    "annotations": filled("@a\n"),
    "digits": filled("1", "int8[", "] a\n"),
    "types": numbered("T{0} a{0}\n"),
    "long names": filled("int8 a\n", "int8 a\n" + RULE + "MSG: " + "a" * 20_000 + "/b\n"),
}
IDL = {
    "blank": filled("\n"),
    "comments": filled("//\n"),
    "comment": filled("*", "/*"),
    "parentheses": filled("(", "module a { const long A = "),
    "nested": "module a { const long A = ((1)); };",
    "sequences": filled("sequence<", STRUCT),
    "fields": numbered("boolean a{0};", STRUCT),
    "constants": filled("const long A=1;", "module a {", "};"),
    "modules": filled("module a {"),
    "annotations": filled("@a ", STRUCT),
    "strings": filled('"a" ', "@v (text=", ") struct A { long a; };"),
    "enumerators": filled("a,", "enum A {"),
    "scopes": filled("a::", STRUCT),
    "long names": filled("struct B { long a; };", "module " + "a" * 20_000 + " {", "};"),
    "shift": "module a { const long A = 1 << 99999999999; };",
}
SIMILAR = {  # to another shape for the parser
    "msg": {"blanks", "spaces", "same", "equals", "slashes", "digits", "annotations", "sections"},
    "idl": {"blank", "comments", "modules", "strings", "scopes", "sequences"},
}
SHAPES = [
    pytest.param(form, name, text, id=f"{form} {name}", marks=pytest.mark.nightly if name in SIMILAR[form] else [])
    for form, shapes in (("msg", MSG), ("idl", IDL))
    for name, text in shapes.items()
]


@pytest.mark.parametrize(("form", "name", "text"), SHAPES)
def test_a27_a_definition_of_64_kib_costs_little_time_and_memory(form: DefinitionFormat, name: str, text: str) -> None:
    tracemalloc.start()
    try:
        with lines_run(1_000_000), contextlib.suppress(DefinitionError):  # some 50 ms
            parse(f"a/msg/{name.title().replace(' ', '')}", text, form, 2)
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak_bytes <= 4 * SIZE + (64 << 10)  # interpreter's own objects


def test_a27_a_longer_definition_is_refused_before_it_is_parsed() -> None:
    with pytest.raises(DefinitionError, match="65536"):
        parse("a/msg/B", "\n" * (SIZE + 1), "msg", 2)
    with pytest.raises(LocalError):
        Channel("/t", "a/msg/B", 2, definition="ä\n" * (SIZE // 2), definition_format="msg").to_wire()


def test_a27_all_definitions_of_a_topic_are_at_most_64_kib() -> None:
    channels = tuple(
        Channel("/t", "a/msg/B", 2, definition=f"# {number}\n" + "\n" * 40_000, definition_format="msg")
        for number in range(2)
    )
    with pytest.raises(LocalError):
        TopicDescription("json", channels).to_wire()
    wires = [channel.to_wire() for channel in channels]
    with pytest.raises(RemoteError):
        TopicDescription.from_cbor(encode({"e": "json", "c": wires}))


def test_a27_many_channels_of_one_definition_are_still_described() -> None:
    channels = tuple(
        Channel("/tf", "a/msg/B", 1, definition="int8 a\n" + "#\n" * 2_000, definition_format="msg", callerid=f"/n{at}")
        for at in range(CHANNELS_MAX)
    )
    assert TopicDescription.from_cbor(TopicDescription("json", channels).to_wire()).channels == channels


@pytest.mark.parametrize("unit", ["float64[64] a{0}\n", "wstring a{0}\n", "bool a{0}\nfloat64 b{0}\n"])
def test_a27_a_type_is_compiled_with_little_work(unit: str) -> None:
    text = "".join(unit.format(number) for number in range(1_000))
    with lines_run(400_000):
        serializer = Serializer(Channel("/t", "a/msg/B", 2, definition=text, definition_format="msg"), "json")
        serializer.encode(bytes([0, 1, 0, 0]) + bytes(1_000))
