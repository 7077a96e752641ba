"""Fields of a client's message, each of the expected kind and bounded; and texts of the rosbridge door.

Sans-I/O. What reads a field raises ``RemoteError`` (MALFORMED) where it is not as expected.
"""

from __future__ import annotations

from typing import Final, TypeAlias

import orjson

from gdp.errors import DropReason, RemoteError

_TEXT_MAX: Final = 1_024

Fields: TypeAlias = "dict[str, object]"


def word(fields: Fields, key: str, limit: int = _TEXT_MAX, *, is_optional: bool = False) -> str:
    """Return a text of at most ``limit`` characters."""
    value = fields.get(key)
    if value is None and is_optional:
        return ""
    if not isinstance(value, str) or len(value) > limit:
        raise wrong(f"{key}: a text of at most {limit} characters was expected")
    return value


def identifier(fields: Fields, default: object = "") -> object:
    """Return the client's id of a request, a text or a number, as it is to be repeated."""
    value = fields.get("id", default)
    if value is None or isinstance(value, bool | int | float):
        return value
    return word(fields, "id") if "id" in fields else value


def whole_number(fields: Fields, key: str, limit: int) -> int:
    """Return a number from 0 to a limit."""
    value = fields.get(key, 0)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= limit:
        raise wrong(f"{key}: a whole number from 0 to {limit} was expected")
    return value


def ros2_type(text: str, part: str) -> str:
    """Return a type as ROS 2 writes it; ``part``: ``msg``, ``srv`` or ``action``."""
    package, slash, name = text.partition("/")
    return f"{package}/{part}/{name}" if slash and "/" not in name else text


def text_of(number: object = None, **fields: object) -> str:
    """Return a message to the client, with the id that it repeats, if any."""
    return orjson.dumps(fields if number is None else fields | {"id": number}).decode()


def wrong(detail: str) -> RemoteError:
    """Return the error of a malformed message."""
    return RemoteError(DropReason.MALFORMED, detail)
