"""Typed accessors for the body of a statement: each returns the one type that it names, or raises.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NoReturn

from gdp.crypto.cbor import Value
from gdp.errors import DropReason, StatementError
from gdp.limits import SEQUENCE_AHEAD_S
from gdp.names import NAME_BYTES, ZERO, Name

__all__ = ["Fields", "check_sequence"]

_UINT_MAX = (1 << 64) - 1
_TEXT_MAX_CHARS = 4_096


class Fields(Mapping[str, Value]):
    """A decoded map. Unknown keys are no error: a later version may have more.

    Every accessor raises ``StatementError`` (MALFORMED) where the key is missing or the value is of another type or out
    of its bounds. A bound left out is that of the wire.
    """

    __slots__ = ("_items",)

    def __init__(self, items: Mapping[str, Value]) -> None:
        self._items = items

    def __getitem__(self, key: str) -> Value:
        return self._items[key]

    def get(self, key: str, default: object = None) -> Any:
        """Return the value of a key, or ``default``."""
        return self._items.get(key, default)

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __repr__(self) -> str:
        return f"Fields({self._items!r})"

    def uint(self, key: str, maximum: int = _UINT_MAX) -> int:
        """Return a whole number from 0 to ``maximum``."""
        value = self._items.get(key)
        if type(value) is not int or not 0 <= value <= maximum:
            _refuse(key, f"a whole number of at most {maximum}")
        return value

    def number(self, key: str, minimum: float, maximum: float) -> float:
        """Return a finite whole or floating number within the bounds."""
        value = self._items.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not minimum <= value <= maximum:
            _refuse(key, f"a number from {minimum} to {maximum}")
        return float(value)

    def flag(self, key: str) -> bool:
        """Return true or false."""
        value = self._items.get(key)
        if not isinstance(value, bool):
            _refuse(key, "true or false")
        return value

    def text(self, key: str, maximum: int = _TEXT_MAX_CHARS) -> str:
        """Return text of at most ``maximum`` characters."""
        value = self._items.get(key)
        if not isinstance(value, str) or len(value) > maximum:
            _refuse(key, f"text of at most {maximum} characters")
        return value

    def bytes_(self, key: str, size: int | None = None) -> bytes:
        """Return bytes: exactly ``size`` of them, or any number."""
        value = self._items.get(key)
        if not isinstance(value, bytes) or (size is not None and len(value) != size):
            _refuse(key, "bytes" if size is None else f"{size} bytes")
        return value

    def name(self, key: str) -> Name:
        """Return a name; zero is none."""
        name = Name(self.bytes_(key, NAME_BYTES))
        if name == ZERO:
            _refuse(key, "a name")
        return name

    def list_(self, key: str, maximum: int) -> list[Value]:
        """Return a list of at most ``maximum`` items of any type."""
        value = self._items.get(key)
        if not isinstance(value, list) or len(value) > maximum:
            _refuse(key, f"a list of at most {maximum} items")
        return value

    def names(self, key: str, maximum: int) -> list[Name]:
        """Return a list of names."""
        names = [Name(item) for item in self.byte_strings(key, maximum, NAME_BYTES)]
        if ZERO in names:
            _refuse(key, "a list of names")
        return names

    def byte_strings(self, key: str, maximum: int, size: int | None = None) -> list[bytes]:
        """Return a list of byte strings, each of ``size`` bytes if given."""
        result: list[bytes] = []
        for item in self.list_(key, maximum):
            if not isinstance(item, bytes) or (size is not None and len(item) != size):
                _refuse(key, "a list of byte strings" if size is None else f"a list of byte strings of {size}")
            result.append(item)
        return result

    def texts(self, key: str, maximum: int) -> list[str]:
        """Return a list of texts."""
        result: list[str] = []
        for item in self.list_(key, maximum):
            if not isinstance(item, str):
                _refuse(key, "a list of texts")
            result.append(item)
        return result

    def map_(self, key: str) -> Fields:
        """Return a map, to be read in the same way."""
        value = self._items.get(key)
        if not isinstance(value, dict):
            _refuse(key, "a map")
        return Fields(value)

    def maps(self, key: str, maximum: int) -> list[Fields]:
        """Return a list of maps."""
        result: list[Fields] = []
        for item in self.list_(key, maximum):
            if not isinstance(item, dict):
                _refuse(key, "a list of maps")
            result.append(Fields(item))
        return result


def check_sequence(sequence: int, unix_s: float) -> None:
    """Return if a sequence number leaves values for newer ones.

    Sequence numbers are milliseconds of wall clocks, which may be wrong. A number of the far future would be the last
    that its owner, or a node that has to exceed it, can use.

    Raises:
        StatementError: MALFORMED.
    """
    if sequence > (unix_s + SEQUENCE_AHEAD_S) * 1_000:
        raise StatementError(DropReason.MALFORMED, "a sequence number of the far future")


def _refuse(key: str, expected: str) -> NoReturn:
    raise StatementError(DropReason.MALFORMED, f"{key!r} is not {expected}")
