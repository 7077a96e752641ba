"""Region of a message that crosses: bounds along axes.

Sans-I/O.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

__all__ = ["Bounds", "Region"]

Bounds: TypeAlias = tuple[float, float]


class Region(NamedTuple):
    """Bounds along each axis, of which the first is inside; None: no bound. Metres for points, pixels for images."""

    x: Bounds | None = None
    y: Bounds | None = None
    z: Bounds | None = None
