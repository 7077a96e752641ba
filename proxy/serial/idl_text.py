"""Parser of the IDL texts that ROS 2 writes: one pass over the tokens, no backtracking.

Sans-I/O. A peer may send the text, so time and memory are proportional to its length, and tokens and nesting are
bounded. The parser accepts modules, structures, constants, typedefs and enumerations with their annotations. A constant
is a literal or the name of another one; expressions with operators are refused, as rosidl refuses them.
Source: OMG IDL 4.2, section 7.4; the ROS 2 article on IDL interfaces.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, TypeAlias

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import BaseDesc, Basename, Constdefs, FieldDesc, NameDesc, Typesdict

from proxy.serial.msg_text import STATEMENTS_MAX, end_of, shortened

_TOKENS_MAX: Final = 16_384  # a text of rosidl has one in five bytes
_DEPTH_MAX: Final = 16  # modules within modules, sequences within sequences
_NUMBER_MAX: Final = (1 << 32) - 1
_DIGITS_MAX: Final = 64
_WORD_MAX: Final = 256
_SPACE: Final = re.compile(r"\s+")
_WORD: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_NUMBER: Final = re.compile(r"[+-]?(?:0[xX][0-9a-fA-F]+|[0-9]*\.?[0-9]*(?:(?<=[0-9.])[eE][+-]?[0-9]+)?)")
_SIGNS: Final = frozenset("{}()<>[];,=@")
_QUOTE_OR_ESCAPE: Final = re.compile(r'["\\]')
_BASES: Final[dict[str, Basename]] = {
    "boolean": "bool",
    "octet": "byte",
    "char": "char",
    "wchar": "wchar",
    "fixed": "fixed",
    "float": "float32",
    "double": "float64",
    "long double": "float128",
    "short": "int16",
    "long": "int32",
    "long long": "int64",
    "unsigned short": "uint16",
    "unsigned long": "uint32",
    "unsigned long long": "uint64",
    "int8": "int8",
    "int16": "int16",
    "int32": "int32",
    "int64": "int64",
    "uint8": "uint8",
    "uint16": "uint16",
    "uint32": "uint32",
    "uint64": "uint64",
}
_PARTS_OF_BASES: Final = frozenset(word for base in _BASES for word in base.split())
_SCALAR: Final = 0

_Value: TypeAlias = "bool | float | int | str"
_Item: TypeAlias = "BaseDesc | NameDesc"


@dataclass(frozen=True, slots=True)
class _Kind:
    """A parsed type: ``node`` 0 for one value, else ``Nodetype.ARRAY`` or ``Nodetype.SEQUENCE`` with its count."""

    item: _Item
    node: int = _SCALAR
    count: int = 0


def parse_idl(text: str) -> Typesdict:
    """Return constants and fields of every structure in a text.

    Raises:
        ValueError: the text is not IDL in the form of ROS 2, or is too long.
    """
    return _Parser(_tokens(text)).types()


def _tokens(text: str) -> Iterator[str]:
    """Yield words, numbers, signs, ``::`` and quoted strings (with their first quote alone)."""
    count = at = 0
    while at < len(text):
        if text[at].isspace():
            at = end_of(_SPACE, text, at)
            continue
        if text.startswith(("//", "/*", "#"), at):
            at = _comment_end(text, at)
            continue
        count += 1
        if count > _TOKENS_MAX:
            raise ValueError(f"more than {_TOKENS_MAX} words and signs")
        stop = _token_end(text, at)
        yield text[at : stop - 1] if text[at] in "'\"" else text[at:stop]
        at = stop


def _token_end(text: str, at: int) -> int:
    sign = text[at]
    if sign in _SIGNS:
        return at + 1
    if text.startswith("::", at):
        return at + 2
    if sign == '"':
        return _string_end(text, at)
    if sign == "'":
        stop = text.find("'", at + 2)
        if 0 < stop <= at + 4:
            return stop + 1
    stop = end_of(_WORD if sign.isascii() and sign.isalpha() else _NUMBER, text, at)
    if stop == at or (stop == at + 1 and sign in "+-."):
        raise ValueError(f"neither a word nor a number: {shortened(text[at : at + 40])}")
    return stop


def _comment_end(text: str, at: int) -> int:
    """Return the end of a comment, or of a preprocessor line."""
    if text[at] == "#" or text[at + 1] == "/":
        stop = text.find("\n", at)
        return len(text) if stop < 0 else stop + 1
    stop = text.find("*/", at + 2)
    if stop < 0:
        raise ValueError("a comment without an end")
    return stop + 2


def _string_end(text: str, at: int) -> int:
    at += 1
    while (found := _QUOTE_OR_ESCAPE.search(text, at)) is not None:
        if found[0] == '"':
            return found.end()
        at = found.end() + 1
    raise ValueError("a string without an end")


class _Parser:
    def __init__(self, tokens: Iterator[str]) -> None:
        self._tokens = tokens
        self._token = next(tokens, "")  # the next one; empty at the end
        self._statements = 0
        self._scope: list[str] = []
        self._types: Typesdict = {}
        self._descs: dict[FieldDesc, FieldDesc] = {}  # equal ones are stored once
        self._aliases: dict[str, _Kind] = {}
        self._constants: dict[str, _Value] = {}
        self._by_scope: dict[str, Constdefs] = {}

    def types(self) -> Typesdict:
        if not self._token:
            raise ValueError("an empty text")
        while self._token:
            self._definition()
        for name, section in self._types.items():
            section[0].extend(self._by_scope.get(f"{name}_Constants", []))
        return self._types

    def _next(self) -> str:
        token, self._token = self._token, next(self._tokens, "")
        return token

    def _expect(self, wanted: str) -> None:
        token = self._next()
        if token != wanted:
            raise ValueError(f"{wanted!r} expected, not {shortened(token)}")

    def _takes(self, wanted: str) -> bool:
        if self._token != wanted:
            return False
        self._next()
        return True

    def _word(self) -> str:
        token = self._next()
        if _WORD.fullmatch(token) is None or len(token) > _WORD_MAX:
            raise ValueError(f"a name expected, not {shortened(token)}")
        return token

    def _full(self, name: str) -> str:
        full = "/".join((*self._scope, name))
        if len(full) > _WORD_MAX:
            raise ValueError(f"a name of more than {_WORD_MAX} characters: {shortened(full)}")
        return full

    def _count(self) -> None:
        self._statements += 1
        if self._statements > STATEMENTS_MAX:
            raise ValueError(f"more than {STATEMENTS_MAX} fields, constants and typedefs")

    def _definition(self) -> None:
        self._annotations()
        word = self._word()
        if word == "module":
            self._module()
        elif word == "const":
            self._constant()
        elif word == "typedef":
            for name, kind in self._declared(self._kind(0)):
                self._aliases[self._full(name)] = kind
        elif word == "struct":
            self._struct()
        elif word == "enum":
            self._enumeration()
        else:
            raise ValueError(f"no definition begins with {shortened(word)}")
        self._expect(";")

    def _module(self) -> None:
        self._scope.append(self._word())
        if len(self._scope) > _DEPTH_MAX:
            raise ValueError(f"more than {_DEPTH_MAX} modules within each other")
        self._expect("{")
        while not self._takes("}"):
            self._definition()
        self._scope.pop()

    def _constant(self) -> None:
        kind = self._kind(0)
        name = self._word()
        self._expect("=")
        self._count()
        value = self._value()
        if kind.item[0] != Nodetype.BASE or kind.node != _SCALAR:
            raise ValueError(f"the constant {name} is of no simple type")
        self._constants[self._full(name)] = value
        self._by_scope.setdefault("/".join(self._scope), []).append((name, kind.item[1][0], value))

    def _struct(self) -> None:
        name = self._full(self._word())
        if self._token == ";":
            return  # forward declaration
        self._expect("{")
        fields: list[tuple[str, FieldDesc]] = []
        while True:
            self._annotations()
            for field, kind in self._declared(self._kind(0)):
                fields.append((field, self._desc(kind)))
            self._expect(";")
            if self._takes("}"):
                break
        self._types[name] = ([], fields)

    def _desc(self, kind: _Kind) -> FieldDesc:
        item = kind.item
        if item[0] == Nodetype.NAME:
            item = (Nodetype.NAME, self._found(item[1], self._types) or self._sibling(item[1]))
        desc: FieldDesc = item
        if kind.node == Nodetype.ARRAY:
            desc = (Nodetype.ARRAY, (item, kind.count))
        elif kind.node == Nodetype.SEQUENCE:
            desc = (Nodetype.SEQUENCE, (item, kind.count))
        return self._descs.setdefault(desc, desc)

    def _sibling(self, name: str) -> str:
        return name if "/" in name else self._full(name)

    def _enumeration(self) -> None:
        self._word()
        self._expect("{")
        while True:
            self._annotations()
            self._word()
            if self._takes("="):
                self._value()
            if not self._takes(","):
                break
        self._expect("}")

    def _declared(self, kind: _Kind) -> list[tuple[str, _Kind]]:
        """Return the names that a declaration defines, with their types."""
        declared = []
        while True:
            name, of = self._word(), kind
            if self._takes("["):
                if kind.node != _SCALAR:
                    raise ValueError(f"{name} is an array of arrays")
                of = _Kind(kind.item, Nodetype.ARRAY, self._size())
                self._expect("]")
            self._count()
            declared.append((name, of))
            if not self._takes(","):
                return declared

    def _kind(self, depth: int) -> _Kind:
        if depth > _DEPTH_MAX:
            raise ValueError(f"more than {_DEPTH_MAX} sequences within each other")
        token = self._token
        if token == "sequence":
            self._next()
            return self._sequence(depth)
        if token in ("string", "wstring"):
            self._next()
            bound = 0
            if self._takes("<"):
                bound = self._size()
                self._expect(">")
            return _Kind((Nodetype.BASE, ("string" if token == "string" else "wstring", bound)))
        if token in _PARTS_OF_BASES:
            self._next()
            while self._token in _PARTS_OF_BASES and f"{token} {self._token}" in _BASES:
                token = f"{token} {self._next()}"
            if token == "unsigned":
                token = f"{token} {self._next()}"
                if f"{token} {self._token}" in _BASES:
                    token = f"{token} {self._next()}"
            if token not in _BASES:
                raise ValueError(f"no type is called {shortened(token)}")
            return _Kind((Nodetype.BASE, (_BASES[token], 0)))
        name = self._scoped()
        alias = self._found(name, self._aliases)
        return self._aliases[alias] if alias else _Kind((Nodetype.NAME, name))

    def _sequence(self, depth: int) -> _Kind:
        self._expect("<")
        inner = self._kind(depth + 1)
        count = self._size() if self._takes(",") else 0
        self._expect(">")
        if inner.node != _SCALAR:
            raise ValueError("a sequence of sequences or arrays")
        return _Kind(inner.item, Nodetype.SEQUENCE, count)

    def _scoped(self) -> str:
        self._takes("::")
        name = self._word()
        while self._takes("::"):
            name = f"{name}/{self._word()}"
            if name.count("/") > _DEPTH_MAX:
                raise ValueError(f"a name of more than {_DEPTH_MAX} parts")
        return name

    def _found(self, name: str, known: Typesdict | dict[str, _Kind] | dict[str, _Value]) -> str:
        """Return the full name that a name refers to in this scope, the innermost first; empty if there is none."""
        for depth in range(len(self._scope), -1, -1):
            full = "/".join((*self._scope[:depth], name))
            if full in known:
                return full
        return ""

    def _size(self) -> int:
        size = self._value()
        if isinstance(size, bool) or not isinstance(size, int) or not 0 <= size <= _NUMBER_MAX:
            raise ValueError(f"no length or bound: {shortened(str(size))}")
        return size

    def _value(self) -> _Value:
        token = self._token
        if token[:1] == '"':
            parts = []
            while self._token[:1] == '"':
                parts.append(self._next()[1:])
            return "".join(parts)
        if token[:1] == "'" or token in ("TRUE", "FALSE"):
            self._next()
            return token[1:] if token[0] == "'" else token == "TRUE"
        if token == "::" or _WORD.fullmatch(token) is not None:
            name = self._scoped()
            found = self._found(name, self._constants)
            if not found:
                raise ValueError(f"no constant is called {shortened(name)}")
            return self._constants[found]
        return _number(self._next())

    def _annotations(self) -> None:
        while self._takes("@"):
            self._scoped()
            if self._takes("("):
                self._skip_arguments()

    def _skip_arguments(self) -> None:
        """Skip the arguments of an annotation, which never change a message's bytes."""
        is_open = 1
        while is_open:
            token = self._next()
            if not token or token in ("{", "}", ";", "@"):
                raise ValueError(f"an annotation with {shortened(token)}")
            is_open += (token == "(") - (token == ")")


def _number(token: str) -> float | int:
    if len(token) > _DIGITS_MAX:
        raise ValueError(f"a number of {len(token)} digits")
    digits = token.lstrip("+-")
    if digits[:2] in ("0x", "0X"):
        return int(token, 16)
    if any(sign in digits for sign in ".eE"):
        return float(token)
    return int(token, 8 if digits[:1] == "0" and len(digits) > 1 else 10)
