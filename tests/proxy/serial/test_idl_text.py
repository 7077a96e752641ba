"""IDL texts of ROS 2: constants, typedefs, enumerations, annotations, and refused texts."""

from __future__ import annotations

import pytest
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc

from proxy.serial.idl_text import parse_idl

INT32: FieldDesc = (Nodetype.BASE, ("int32", 0))


def fields(members: str, before: str = "") -> dict[str, FieldDesc]:
    """Return the fields of the structure ``a/msg/B``; ``before``: definitions in front of it."""
    types = parse_idl(f"module a {{ module msg {{ {before} struct B {{ {members} }}; }}; }};")
    return dict(types["a/msg/B"][1])


def constant(definition: str, before: str = "") -> tuple[str, object]:
    """Return type and value of the last constant of the structure ``a/B``."""
    text = f"module a {{ module B_Constants {{ {before} {definition} }}; struct B {{ long x; }}; }};"
    _, kind, value = parse_idl(text)["a/B"][0][-1]
    return kind, value


@pytest.mark.parametrize(
    ("word", "base"),
    [
        ("unsigned long long", "uint64"),
        ("unsigned long", "uint32"),
        ("unsigned short", "uint16"),
        ("long long", "int64"),
        ("long double", "float128"),
        ("double", "float64"),
        ("octet", "byte"),
        ("uint8", "uint8"),
        ("wchar", "wchar"),
    ],
)
def test_a_type_of_several_words_is_one_type(word: str, base: str) -> None:
    assert fields(f"{word} x;") == {"x": (Nodetype.BASE, (base, 0))}


def test_one_declaration_may_define_several_fields() -> None:
    assert fields("long x, y[3];") == {"x": INT32, "y": (Nodetype.ARRAY, (INT32, 3))}


def test_a_bound_may_be_a_constant_of_an_outer_module() -> None:
    found = fields("string<SIZE> text; sequence<long, SIZE> numbers;", "const unsigned long SIZE = 7;")
    assert found["text"] == (Nodetype.BASE, ("string", 7))
    assert found["numbers"] == (Nodetype.SEQUENCE, (INT32, 7))


def test_a_typedef_stands_for_its_type() -> None:
    found = fields("three x; ::a::msg::three y;", "typedef long three[3];")
    assert found == {"x": (Nodetype.ARRAY, (INT32, 3)), "y": (Nodetype.ARRAY, (INT32, 3))}


def test_a_type_without_a_module_is_one_of_the_same_module() -> None:
    assert fields("C c; d::msg::D d;") == {"c": (Nodetype.NAME, "a/msg/C"), "d": (Nodetype.NAME, "d/msg/D")}


def test_a_forward_declaration_defines_nothing() -> None:
    assert fields("long x;", "struct B;") == {"x": INT32}


def test_an_enumeration_and_annotations_change_no_field() -> None:
    before = '@verbatim (language="comment", text="a ; } @" "b") enum Colour { RED, @value(3) BLUE = 3 };'
    assert fields('@key @unit(value="m") @range(min=(1), max=2) long x;', before) == {"x": INT32}


def test_comments_and_preprocessor_lines_are_left_out() -> None:
    assert fields("// one }\n/* two\n} */ long x;\n#include <three>\n") == {"x": INT32}


@pytest.mark.parametrize(
    ("definition", "kind", "value"),
    [
        ("const boolean X = TRUE;", "bool", True),
        ("const char X = 'a';", "char", "a"),
        ('const string X = "a \\" b" "c";', "string", 'a \\" bc'),
        ("const double X = -1.5e3;", "float64", -1500.0),
        ("const long X = 0x1F;", "int32", 31),
        ("const long X = 017;", "int32", 15),
        ("const long X = -12;", "int32", -12),
    ],
)
def test_a_constant_has_the_value_of_its_literal(definition: str, kind: str, value: object) -> None:
    assert constant(definition) == (kind, value)


def test_a_constant_may_be_the_value_of_another_one() -> None:
    assert constant("const long Y = B_Constants::X;", "const long X = 5;") == ("int32", 5)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "an empty text"),
        ("union a {};", "no definition begins with 'union'"),
        ("module a { struct B { long x; }; }", "';' expected, not ''"),
        ("struct B { long 3; };", "a name expected, not '3'"),
        ("struct B { long x }; ", "';' expected, not '}'"),
        ("struct B { unsigned float x; };", "no type is called 'unsigned float'"),
        ("struct B { long x[-1]; };", "no length or bound: '-1'"),
        ("struct B { long x[1.5]; };", "no length or bound: '1.5'"),
        ("struct B { long x[MISSING]; };", "no constant is called 'MISSING'"),
        ("typedef long three[3]; struct B { three x[2]; };", "x is an array of arrays"),
        ("struct B { sequence<sequence<long>> x; };", "a sequence of sequences or arrays"),
        ("typedef long three[3]; const three X = 1;", "the constant X is of no simple type"),
        ("/* no end", "a comment without an end"),
        ('const string X = "no end', "a string without an end"),
        ("const long X = 1 + 2;", "neither a word nor a number: "),
        ("@a(; struct B { long x; };", "an annotation with ';'"),
        (f"const long X = {'1' * 65};", "a number of 65 digits"),
        (f"struct {'B' * 257} {{ long x; }};", "a name expected"),
        ("module a { " * 17, "more than 16 modules within each other"),
        (f"struct B {{ {'sequence<' * 18} long", "more than 16 sequences within each other"),
        (f"struct B {{ {'a::' * 20}C x; }};", "a name of more than 16 parts"),
        ("; " * 16_385, "no definition begins|a name expected"),
        ("struct B { long x; }; " * 3_000, "more than 16384 words and signs"),
    ],
)
def test_a_text_that_is_not_idl_of_ros_2_is_refused_with_the_reason(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse_idl(text)
