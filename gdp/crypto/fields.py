"""Typed accessors for a received map whose keys depend on an earlier one: each returns its one type, or raises.

Sans-I/O. A map whose keys are known is a ``FieldSet`` (``schema.py``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, TypeVar

from gdp.crypto.cbor import Value
from gdp.crypto.schema import FLAG, MAP, OCTETS, Form, Keyed, many, number, octets, text, uint

__all__ = ["Fields"]

_T = TypeVar("_T")
_TEXT_MAX_CHARS: Final = 4_096


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

    def read(self, key: str, form: Form[_T]) -> _T:
        """Return a value of any form."""
        return Keyed(key, form).read(self._items)

    def uint(self, key: str, maximum: int | None = None) -> int:
        """Return a whole number from 0 to ``maximum``."""
        return self.read(key, uint() if maximum is None else uint(maximum))

    def number(self, key: str, minimum: float, maximum: float) -> float:
        """Return a finite whole or floating number within the bounds."""
        return self.read(key, number(minimum, maximum))

    def flag(self, key: str) -> bool:
        """Return true or false."""
        return self.read(key, FLAG)

    def text(self, key: str, maximum: int = _TEXT_MAX_CHARS) -> str:
        """Return text of at most ``maximum`` characters."""
        return self.read(key, text(maximum))

    def bytes_(self, key: str, size: int | None = None) -> bytes:
        """Return bytes: exactly ``size`` of them, or any number."""
        return self.read(key, OCTETS if size is None else octets(size))

    def byte_strings(self, key: str, maximum: int) -> list[bytes]:
        """Return a list of byte strings."""
        return [*self.read(key, many(OCTETS, maximum))]

    def texts(self, key: str, maximum: int) -> list[str]:
        """Return a list of texts."""
        return [*self.read(key, many(text(_TEXT_MAX_CHARS), maximum))]

    def maps(self, key: str, maximum: int) -> list[Fields]:
        """Return a list of maps, to be read in the same way."""
        return [Fields(each) for each in self.read(key, many(MAP, maximum))]
