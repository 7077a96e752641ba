"""Messages drawn by their definition, and their bytes, both by rosbags."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from random import Random
from typing import Any, Final

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from proxy.serial.channel import RosVersion

__all__ = ["drawn_message", "wire_of"]

Texts = Mapping[str, Sequence[str]]
_BITS: Final = {"bool": "?", "octet": "B", "byte": "B", "char": "B"}


def _values(store: Typestore, desc: Any, draw: Random, texts: Sequence[str], named: Texts) -> Any:
    """Return a drawn value of a field as rosbags describes it."""
    what, detail = desc
    if what == Nodetype.NAME:
        return drawn_message(store, detail, draw, named)
    if what == Nodetype.BASE:
        if detail[0] in ("string", "wstring"):
            return draw.choice(texts) if texts else "x" * draw.randrange(9)
        return draw.randrange(2) if detail[0] != "bool" else bool(draw.randrange(2))
    inner, count = detail
    is_numbers = inner[0] == Nodetype.BASE and inner[1][0] not in ("string", "wstring")
    count = count if what == Nodetype.ARRAY else draw.choice((0, 1, 3, 5_000 if is_numbers else 2))
    if is_numbers:
        return np.resize(np.array([0, 1, 1]), count).astype(_BITS.get(inner[1][0], inner[1][0]))
    return [_values(store, inner, draw, texts, named) for _ in range(count)]


def drawn_message(store: Typestore, type_name: str, draw: Random, texts: Texts) -> Any:
    """Return a message with drawn values; ``texts``: those that fields of a name have."""
    values = {
        name: _values(store, desc, draw, texts.get(name, ()), texts) for name, desc in store.fielddefs[type_name][1]
    }
    return store.types[type_name](**values)


def wire_of(store: Typestore, ros: RosVersion, message: Any, type_name: str) -> bytes:
    """Return a message's bytes in either ROS's wire form."""
    return bytes(store.serialize_ros1(message, type_name) if ros == 1 else store.serialize_cdr(message, type_name))
