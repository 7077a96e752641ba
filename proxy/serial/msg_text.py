"""Parser of ``msg`` definition texts: one pass over the lines, no backtracking.

Sans-I/O. A peer may send the text, so time and memory are proportional to its length, and the number of fields and
constants is bounded. It accepts the constructs of ROS 1 and ROS 2: comments, constants, default values, bounds,
annotations, used types after a line of 80 ``=`` and a line ``MSG: name``.
Source: ROS 1 ``msg`` wiki page; the ROS 2 interface definition article.
"""

from __future__ import annotations

import re
from typing import Final, TypeAlias

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import BaseDesc, Basename, Constdefs, Fielddefs, FieldDesc, NameDesc, Typesdict

STATEMENTS_MAX: Final = 2_048  # fields and constants of one text
_NUMBER_DIGITS_MAX: Final = 10
_SECTIONS_MAX: Final = 1_024
_WORD_MAX: Final = 256  # characters of a type's name
_SHAPES_MAX: Final = 256  # different field types of one type
_RULE: Final = "=" * 80
_NAMES: Final[tuple[Basename, ...]] = (
    "bool",
    "byte",
    "char",
    "float32",
    "float64",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "uint16",
    "uint32",
    "uint64",
    "string",
    "wstring",
)
_BASES: Final[dict[str, Basename]] = {name: name for name in _NAMES}
_SHORT: Final = {
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
    "Header": "std_msgs/msg/Header",
}
_BLANK: Final = re.compile(r"[ \t\n]*")
_SPACE: Final = re.compile(r"[ \t]*")
_ANNOTATION: Final = re.compile(r"@[a-z]+(?![^ \t])[ \t]*")
# type, text bound, brackets, their "<=", their number
_TYPE: Final = re.compile(r"([A-Za-z][A-Za-z0-9_/]*)(?:<=([0-9]+))?(\[(<=)?([0-9]*)\])?[ \t]+")
_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_HEADER: Final = re.compile(r"MSG: ([A-Za-z0-9/_]+)[ \t]*$")
_FLOAT: Final = re.compile(
    r"[+-]?(?:[0-9]+\.[0-9]*(?:[eE][+-]?[0-9]+)?|\.[0-9]+(?:[eE][+-]?[0-9]+)?|[0-9]+[eE][+-]?[0-9]+)"
)
_INTEGER: Final = re.compile(r"[+-]?(?:0[xX][0-9a-fA-F]+|0b[01]+|[0-9]+)")
_TRUTH: Final = re.compile(r"true|false", re.IGNORECASE)
_QUOTE_OR_ESCAPE: Final = re.compile(r"""['"\\]""")
_COMMENT: Final = re.compile(r"[ \t]*(?:#.*)?$")

_Item: TypeAlias = "BaseDesc | NameDesc"
_Value: TypeAlias = "bool | float | int | str"
Default: TypeAlias = "_Value | list[_Value]"


def parse_msg(text: str, type_name: str) -> Typesdict:
    """Return constants and fields of every type in a text.

    Args:
        text: lines end with ``\\n``.
        type_name: of the first type, such as ``sensor_msgs/msg/Image``.

    Raises:
        ValueError: the text is no definition, or has more than ``STATEMENTS_MAX`` fields and constants.
    """
    return _Parser(text).types(type_name)


def defaults_of(text: str, type_name: str) -> dict[tuple[str, str], Default]:
    """Return the default values that a text states, by type and field; arguments and errors as ``parse_msg``."""
    parser = _Parser(text)
    parser.types(type_name)
    return {field: _default(value) for field, value in parser.defaults.items()}


class _Parser:
    def __init__(self, text: str) -> None:
        self.defaults: dict[tuple[str, str], str] = {}  # their texts
        self._text = text
        self._owner = ""
        self._statements = 0
        self._shapes: dict[str, FieldDesc] = {}  # of the section, by their text

    def types(self, type_name: str) -> Typesdict:
        types: Typesdict = {}
        constants, fields = self._begin(type_name, types)
        at = 0
        while True:
            blank = _BLANK.match(self._text, at)
            at = at if blank is None else blank.end()
            if at == len(self._text):
                return types
            stop = self._text.find("\n", at)
            stop = len(self._text) if stop < 0 else stop
            line = self._text[at:stop]
            at = stop + 1
            if line[0] == "#":
                continue
            if line[0] == "=":
                stop = self._text.find("\n", at)
                stop = len(self._text) if stop < 0 else stop
                constants, fields = self._section(line, self._text[at:stop], types)
                at = stop + 1
            else:
                self._statement(line, constants, fields)
            if at >= len(self._text):
                return types

    def _section(self, rule: str, head: str, types: Typesdict) -> tuple[Constdefs, Fielddefs]:
        header = _HEADER.match(head)
        if rule.rstrip() != _RULE or header is None:
            raise ValueError(f"not the beginning of a used type: {shortened(rule)} {shortened(head)}")
        return self._begin(header[1], types)

    def _begin(self, name: str, types: Typesdict) -> tuple[Constdefs, Fielddefs]:
        if len(name) > _WORD_MAX:
            raise ValueError(f"a type's name of {len(name)} characters")
        if len(types) >= _SECTIONS_MAX:
            raise ValueError(f"more than {_SECTIONS_MAX} types")
        self._owner = name if name.rpartition("/")[0].rpartition("/")[2] in ("msg", "action") else _with_msg(name)
        self._shapes = {}
        types[self._owner] = ([], [])
        return types[self._owner]

    def _statement(self, line: str, constants: Constdefs, fields: Fielddefs) -> None:
        at = 0
        while (annotation := _ANNOTATION.match(line, at)) is not None:
            at = annotation.end()
        if at and (at == len(line) or line[at] == "#"):
            return
        kind = _TYPE.match(line, at)
        name = None if kind is None else _NAME.match(line, kind.end())
        if kind is None or name is None:
            raise ValueError(f"neither a field nor a constant: {shortened(line)}")
        self._statements += 1
        if self._statements > STATEMENTS_MAX:
            raise ValueError(f"more than {STATEMENTS_MAX} fields and constants")
        at = end_of(_SPACE, line, name.end())
        if line.startswith("=", at):
            if kind[1] not in _BASES or kind[3]:
                raise ValueError(f"a constant of such a type: {shortened(line)}")
            if kind[1] != "wstring":
                text = line[at + 1 :]
                value = "" if kind[1] == "string" and not text.strip() else _value(text, line)  # legal in ROS 1
                constants.append((name[0], _BASES[kind[1]], value))
            return
        if at < len(line) and line[at] != "#" and at == name.end():
            raise ValueError(f"not the name of a field: {shortened(line)}")
        if at < len(line) and line[at] != "#":
            self.defaults[self._owner, name[0]] = line[at:]
        fields.append((name[0], self._shape(kind, line)))

    def _shape(self, kind: re.Match[str], line: str) -> FieldDesc:
        word = kind[0].rstrip()
        if word not in self._shapes:
            if len(self._shapes) >= _SHAPES_MAX:
                raise ValueError(f"more than {_SHAPES_MAX} kinds of fields in one type")
            self._shapes[word] = self._new_shape(word, kind, line)
        return self._shapes[word]

    def _new_shape(self, word: str, kind: re.Match[str], line: str) -> FieldDesc:
        if len(word) > _WORD_MAX:
            raise ValueError(f"a field's type of {len(word)} characters")
        if kind[2] and kind[1] not in ("string", "wstring"):
            raise ValueError(f"a bound of what is no string: {shortened(line)}")
        item: _Item
        if kind[1] in _BASES:  # the bound of a wide string affects no wire form and no hash here
            item = (Nodetype.BASE, (_BASES[kind[1]], _number(kind[2]) if kind[2] and kind[1] == "string" else 0))
        else:
            item = (Nodetype.NAME, self._full(kind[1]))
        if not kind[3]:
            return item
        if kind[5] and not kind[4]:
            return (Nodetype.ARRAY, (item, _number(kind[5])))
        if kind[4] and not kind[5]:
            raise ValueError(f"a bound without a number: {shortened(line)}")
        return (Nodetype.SEQUENCE, (item, _number(kind[5]) if kind[5] else 0))

    def _full(self, word: str) -> str:
        word = _SHORT.get(word, word)
        if "/" not in word:
            return f"{self._owner.rpartition('/')[0]}/{word}"
        if "/msg/" not in word and "/action/" not in word:
            return _with_msg(word)
        return word


def _with_msg(name: str) -> str:
    package, _, word = name.rpartition("/")
    return f"{package}/msg/{word}"


def _default(text: str) -> Default:
    """Return a default value: one, or a list in brackets."""
    if not text.startswith("["):
        return _value(text, text)
    inner = text.partition("]")[0][1:]
    return [_value(each, text) for each in inner.split(",")] if inner.strip() else []


def _value(text: str, line: str) -> _Value:
    """Return the value of a constant: a number or bool that ends the line, or the text itself."""
    text = text.lstrip(" \t")
    for pattern, read in ((_FLOAT, float), (_INTEGER, _integer), (_TRUTH, _is_true)):
        found = pattern.match(text)
        if found is not None and _COMMENT.match(text, found.end()) is not None:
            return read(found[0])
    if not text or text[0] == "#":
        raise ValueError(f"a constant without a value: {shortened(line)}")
    stop = _closing_quote(text) if text[0] in "'\"" else 0
    if stop and _COMMENT.match(text, stop + 1) is not None:
        return text[1:stop]
    return text.strip()


def _closing_quote(text: str) -> int:
    """Return the end of the string that begins a text, 0 if it is not closed."""
    at = 1
    while (found := _QUOTE_OR_ESCAPE.search(text, at)) is not None:
        if found[0] == text[0]:
            return found.start()
        at = found.end() + (found[0] == "\\")
    return 0


def _integer(text: str) -> int:
    digits = text.lstrip("+-")
    if len(digits) > 2 and digits[1] in "xXb":
        return int(text, 0)
    return int(text, 8 if digits[0] == "0" and digits.strip("01234567") == "" and len(digits) > 1 else 10)


def _is_true(text: str) -> bool:
    return text.lower() == "true"


def _number(digits: str) -> int:
    if len(digits) > _NUMBER_DIGITS_MAX:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


def end_of(pattern: re.Pattern[str], text: str, at: int) -> int:
    """Return where a match at a position ends; the position itself if there is none."""
    found = pattern.match(text, at)
    return at if found is None else found.end()


def shortened(text: str) -> str:
    """Return a text for an error: quoted, and cut after 80 characters."""
    return repr(text if len(text) <= 80 else f"{text[:80]} ...")
