"""Keeping of an exposed topic: its ring on this machine's disk, and the holder of its capsule.

Section of a configuration file.
"""

from __future__ import annotations

import re
from typing import Annotated, Final

from pydantic import BeforeValidator, Field, WithJsonSchema

from gdp.config.schema import Section

_UNITS: Final = {"": 1, "B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}
_SIZE: Final = re.compile(r"(\d+)\s*([A-Za-z]*)")
DISK_MIN_BYTES: Final = 1 << 20


def read_size(value: object) -> object:
    """Return the bytes that a text such as ``2GB`` states; another value is passed on and refused as such."""
    if not isinstance(value, str):
        return value
    found = _SIZE.fullmatch(value.strip())
    if found is None or found[2] not in _UNITS:
        raise ValueError(f"expected bytes, such as 500MB or 2GiB, not {value!r}")
    return int(found[1]) * _UNITS[found[2]]


def _services(value: object) -> object:
    return (value,) if isinstance(value, str) else tuple(value) if isinstance(value, list) else value


class Keep(Section):
    """What is kept of a topic, and who holds it."""

    disk: Annotated[
        int,
        BeforeValidator(read_size),
        WithJsonSchema({"anyOf": [{"type": "integer", "minimum": DISK_MIN_BYTES}, {"type": "string"}]}),
    ] = Field(default=10**9, ge=DISK_MIN_BYTES, description="Most bytes that wait here, such as `2GB`.")
    to: Annotated[
        tuple[Annotated[str, Field(min_length=1)], ...],
        BeforeValidator(_services),
        WithJsonSchema({"anyOf": [{"type": "string", "minLength": 1}, {"type": "array", "items": {"type": "string"}}]}),
    ] = Field(
        min_length=1,
        description="The holder's service, as `gdp delegate` named it, or 64 hex digits; or a list: each holds all.",
    )
