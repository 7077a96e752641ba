"""Sections of a rule about sending less: compression, region, and adaptation to the path.

Section of a configuration file. Validation reads a dictionary file and changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final, Literal, TypeAlias

from pydantic import BeforeValidator, Field, ValidationInfo, WithJsonSchema, model_validator

from gdp.config.schema import Section, or_short, relative
from gdp.errors import LocalError
from gdp.extras import Seam

CLOUD: Final = "sensor_msgs/msg/PointCloud2"
IMAGE: Final = "sensor_msgs/msg/Image"
QUALITY: Final = 80  # of JPEG, where none is stated
MIN_HZ: Final = 1.0
MIN_QUALITY: Final = 30
LEVEL_MAX: Final = 19  # higher ones need more memory than a robot may have
_LEVEL: Final = 3
_DICTIONARIES: Final[Seam[Callable[[bytes], bytes]]] = Seam("gdp.dictionary", {"zstd": "proxy"})
_RATE_MAX_HZ: Final = 1e6


def _dictionary(value: object, info: ValidationInfo) -> object:
    """Read the dictionary file that ``dictionary`` names; a value that is not text is passed on and refused as such."""
    if not isinstance(value, str):
        return value
    path = relative(Path(value), info)
    try:
        return _DICTIONARIES.get("zstd", "dictionary")(path.read_bytes())
    except OSError as error:
        raise ValueError(f"expected a dictionary of zstd --train: {path}: {error.strerror}") from error
    except LocalError as error:
        raise ValueError(f"expected a dictionary of zstd --train: {path}: {error}") from error


def _bounds(value: object) -> object:
    if isinstance(value, list):
        value = tuple(value)
    if isinstance(value, tuple) and len(value) == 2 and all(isinstance(each, int | float) for each in value):
        low, high = value
        if not low < high:
            raise ValueError("expected [low, high] with low below high")
    return value


Bounds: TypeAlias = tuple[float, float]  # of which the first is inside
Dictionary = Annotated[bytes, BeforeValidator(_dictionary), WithJsonSchema({"type": "string", "minLength": 1})]
SomeBounds = Annotated[Bounds | None, BeforeValidator(_bounds)]


class Compress(Section):
    """How the bodies of a topic are compressed."""

    codec: Literal["zstd"] = Field(
        default="zstd", description="RFC 8878; what does not shrink by 3 % travels as it is."
    )
    level: int = Field(default=_LEVEL, ge=1, le=LEVEL_MAX, description="1 (fast) to 19 (small).")
    dictionary: Dictionary | None = Field(
        default=None, repr=False, description="File of `zstd --train`, at most 32 KiB; readers get it."
    )


class Region(Section):
    """The part of an image or a point cloud that crosses."""

    x: SomeBounds = Field(default=None, description="`[low, high]`: pixels from the left, or metres.")
    y: SomeBounds = Field(default=None, description="`[low, high]`: pixels from the top, or metres.")
    z: SomeBounds = Field(default=None, description="`[low, high]` in metres, of point clouds.")


class Adapt(Section):
    """Bounds between which rate and JPEG quality follow the path."""

    min_hz: float = Field(default=MIN_HZ, gt=0, le=_RATE_MAX_HZ, description="The rate never falls below this.")
    max_hz: float | None = Field(
        default=None, gt=0, le=_RATE_MAX_HZ, description="The highest rate. `null`: the rule's `max_hz`, or all."
    )
    min_quality: int = Field(default=MIN_QUALITY, ge=1, le=100, description="The lowest JPEG quality.")
    max_quality: int | None = Field(
        default=None, ge=1, le=100, description="The highest JPEG quality. `null`: the rule's `quality`."
    )

    @model_validator(mode="after")
    def _is_ordered(self) -> Adapt:
        if self.max_hz is not None and self.max_hz < self.min_hz:
            raise ValueError("max_hz is below min_hz")
        if (QUALITY if self.max_quality is None else self.max_quality) < self.min_quality:
            raise ValueError("max_quality is below min_quality")
        return self


def _compress(value: object) -> object:
    return {"codec": value} if isinstance(value, str) else value


def _adapt(value: object) -> object:
    if isinstance(value, bool):
        return {} if value else None
    return value


SomeCompress = Annotated[Compress | None, BeforeValidator(_compress), or_short({"const": "zstd"})]
SomeAdapt = Annotated[Adapt | None, BeforeValidator(_adapt), or_short({"type": "boolean"})]
