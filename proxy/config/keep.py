"""Keeping of an exposed topic: its ring on this machine's disk, the holder of its capsule, and around what it is kept.

Section of a configuration file.
"""

from __future__ import annotations

import re
from typing import Annotated, Final

from pydantic import BeforeValidator, Field, WithJsonSchema

from gdp.config.schema import Section
from gdp.intervals import HOUR_S, MINUTE_S

_UNITS: Final = {"": 1, "B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}
_SIZE: Final = re.compile(r"(\d+)\s*([A-Za-z]*)")
_SPAN: Final = re.compile(r"^\d+(\.\d+)?s$")
DISK_MIN_BYTES: Final = 1 << 20
UPLINK_LOST: Final = "uplink-lost"
_BEFORE_S, _AFTER_S = MINUTE_S, MINUTE_S / 2


def read_size(value: object) -> object:
    """Return the bytes that a text such as ``2GB`` states; another value is passed on and refused as such."""
    if not isinstance(value, str):
        return value
    found = _SIZE.fullmatch(value.strip())
    if found is None or found[2] not in _UNITS:
        raise ValueError(f"expected bytes, such as 500MB or 2GiB, not {value!r}")
    return int(found[1]) * _UNITS[found[2]]


def read_span(value: object) -> object:
    """Return the seconds that a text such as ``60s`` states; another value is passed on."""
    return float(value[:-1]) if isinstance(value, str) and _SPAN.fullmatch(value) else value


def _listed(value: object) -> object:
    return (value,) if isinstance(value, str) else tuple(value) if isinstance(value, list) else value


Span = Annotated[
    float | None,
    BeforeValidator(read_span),
    WithJsonSchema({"anyOf": [{"type": "number", "minimum": 0}, {"type": "string", "pattern": _SPAN.pattern}]}),
]


Services = Annotated[
    tuple[Annotated[str, Field(min_length=1)], ...],
    BeforeValidator(_listed),
    WithJsonSchema({"anyOf": [{"type": "string", "minLength": 1}, {"type": "array", "items": {"type": "string"}}]}),
]


class Keep(Section):
    """What is kept of a topic, and who holds it."""

    disk: Annotated[
        int,
        BeforeValidator(read_size),
        WithJsonSchema({"anyOf": [{"type": "integer", "minimum": DISK_MIN_BYTES}, {"type": "string"}]}),
    ] = Field(default=10**9, ge=DISK_MIN_BYTES, description="Most bytes that wait here, such as `2GB`.")
    capsule: str | None = Field(
        default=None,
        pattern=r"^[a-z][a-z0-9_-]{0,62}$",
        description="Label: the topics of one label are kept together. Default: each by itself.",
    )
    before: Span = Field(
        default=None, ge=0, le=HOUR_S, description="Time before an event, such as `60s`; only windows are uploaded."
    )
    after: Span = Field(default=None, ge=0, le=HOUR_S, description="Time after an event.")
    when: Annotated[
        tuple[str, ...],
        BeforeValidator(_listed),
        WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}]}),
    ] = Field(
        default=(),
        description="Events: a topic's message, a call of an exposed service, an exposed action's `/goal` or `/result`,"
        " `uplink-lost`, or a fault's word.",
    )
    to: Services = Field(
        min_length=1,
        description="The holder's service, as `gdp delegate` named it, or 64 hex digits; or a list: each holds all.",
    )

    def disagreement(self, other: Keep) -> str:
        """Return the key that two rules of one capsule state differently, empty where there is none."""
        if self.capsule is None or self.capsule != other.capsule:
            return ""
        keys = ("disk", "before", "after", "to")
        return next((key for key in keys if getattr(self, key) != getattr(other, key)), "")

    @property
    def around_ns(self) -> tuple[int, int] | None:
        """Return what is kept before and after an event, in nanoseconds; None: everything is kept."""
        if self.before is None and self.after is None and not self.when:
            return None
        before_s = _BEFORE_S if self.before is None else self.before
        return int(before_s * 1e9), int((_AFTER_S if self.after is None else self.after) * 1e9)
