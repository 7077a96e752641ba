"""Events: lines of JSON by which a command reports its progress.

Sans-I/O. Every line is an object with the text key ``event``; the reader requests its other values by type.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

from gdp.errors import LocalError


@dataclass(frozen=True, slots=True)
class Event:
    """One line. The accessors return a value of the requested type, or raise ``LocalError``."""

    fields: Mapping[str, object]

    @classmethod
    def from_line(cls, line: str) -> Event:
        """Read a line. Raises ``LocalError``: it is not a JSON object."""
        try:
            fields: object = json.loads(line)
        except ValueError as error:
            raise LocalError(f"a line of JSON was expected, not {line[:80]!r}") from error
        if not isinstance(fields, dict):
            raise LocalError(f"a JSON object was expected, not {line[:80]!r}")
        return cls(fields)

    @property
    def name(self) -> str:
        """Return the name of the event, such as ``ready``."""
        return self.text("event")

    def text(self, key: str) -> str:
        """Return a text."""
        value = self.fields.get(key)
        if not isinstance(value, str):
            raise self._wrong(key, "a text")
        return value

    def text_or_none(self, key: str) -> str | None:
        """Return a text, or None for null and for a missing key."""
        return None if self.fields.get(key) is None else self.text(key)

    def count(self, key: str) -> int:
        """Return a whole number."""
        value = self.fields.get(key)
        if not isinstance(value, int) or isinstance(value, bool):
            raise self._wrong(key, "a whole number")
        return value

    def number_or_none(self, key: str) -> float | None:
        """Return a number, or None for null and for a missing key."""
        value = self.fields.get(key)
        if value is None:
            return None
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise self._wrong(key, "a number")
        return float(value)

    def counts(self, key: str) -> list[int]:
        """Return a list of whole numbers; empty for a missing key."""
        value = self.fields.get(key, [])
        if not isinstance(value, list) or not all(isinstance(item, int) for item in value):
            raise self._wrong(key, "a list of whole numbers")
        return value

    def texts(self, key: str) -> list[str]:
        """Return a list of texts."""
        value = self.fields.get(key)
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self._wrong(key, "a list of texts")
        return value

    def parts(self, key: str) -> list[Event]:
        """Return a list of objects."""
        value = self.fields.get(key)
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self._wrong(key, "a list of objects")
        return [Event(item) for item in value]

    def part(self, key: str) -> Event:
        """Return an object; empty for a missing key."""
        value = self.fields.get(key, {})
        if not isinstance(value, dict):
            raise self._wrong(key, "an object")
        return Event(value)

    def _wrong(self, key: str, expected: str) -> LocalError:
        return LocalError(f"{self.fields.get('event', 'a line')}: {key}: {expected} was expected")
