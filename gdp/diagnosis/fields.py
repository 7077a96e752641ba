"""JSON form of facts: nested frozen dataclasses to mappings and back.

Sans-I/O. Facts of another node are untrusted: each value must have the type of its field, and collections are bounded.
An unknown key is ignored and an absent one has its default, so that versions may differ.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache
from types import UnionType
from typing import Any, Final, TypeVar, Union, get_args, get_origin, get_type_hints

from gdp.errors import DropReason, StatementError

ITEMS_MAX: Final = 256  # of one collection
TEXT_MAX_CHARS: Final = 1_024

_T = TypeVar("_T")


def to_fields(facts: object) -> dict[str, object]:
    """Return the JSON form of a dataclass, without the fields that have their default values."""
    assert is_dataclass(facts)
    assert not isinstance(facts, type)
    given = ((each, getattr(facts, each.name)) for each in fields(facts))
    return {each.name: _shown(value) for each, value in given if value != _default(each)}


def from_fields(kind: type[_T], given: Mapping[str, object]) -> _T:
    """Return the dataclass of a JSON form.

    Raises:
        StatementError: MALFORMED, a value of another type, or a collection above the limit.
    """
    hints = _hints(kind)  # type: ignore[arg-type]  # a class can be hashed
    assert is_dataclass(kind)
    values = {each.name: _value(hints[each.name], given[each.name]) for each in fields(kind) if each.name in given}
    try:
        return kind(**values)
    except TypeError as error:
        raise StatementError(DropReason.MALFORMED, f"facts without a field that they need: {error}") from error


@cache
def _hints(kind: Hashable) -> dict[str, Any]:
    return get_type_hints(kind)


def _default(each: Field[object]) -> object:
    return each.default if each.default_factory is MISSING else each.default_factory()


def _shown(value: object) -> object:
    if is_dataclass(value):
        return to_fields(value)
    if isinstance(value, tuple | list):
        return [_shown(each) for each in value]
    return dict(value) if isinstance(value, Mapping) else value.value if isinstance(value, Enum) else value


def _value(wanted: Any, value: object) -> object:
    origin = get_origin(wanted)
    if origin in (Union, UnionType):
        return None if value is None else _value(next(each for each in get_args(wanted) if each is not _NONE), value)
    if origin is tuple and isinstance(value, list | tuple) and len(value) <= ITEMS_MAX:
        return tuple(_value(get_args(wanted)[0], each) for each in value)
    if origin is Mapping and isinstance(value, Mapping) and len(value) <= ITEMS_MAX:
        key, content = get_args(wanted)
        return {_value(key, each): _value(content, its) for each, its in value.items()}
    if is_dataclass(wanted) and isinstance(wanted, type) and isinstance(value, Mapping):
        return from_fields(wanted, {str(key): its for key, its in value.items()})
    if wanted is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if isinstance(wanted, type) and issubclass(wanted, Enum) and value in [each.value for each in wanted]:
        return wanted(value)
    if isinstance(wanted, type) and type(value) is wanted and not (isinstance(value, str) and _is_long(value)):
        return value
    raise StatementError(DropReason.MALFORMED, "facts of another form")


def _is_long(text: str) -> bool:
    return len(text) > TEXT_MAX_CHARS


_NONE: Final = type(None)
