"""Control of a rule: of several far publishers one at a time is heard, and its silence ends in a message of stop.

Section of a configuration file.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import BeforeValidator, Field, JsonValue, WithJsonSchema

from gdp.config.schema import Section, or_short
from gdp.intervals import MINUTE_S, PROMPT_S

EXCLUSIVE: Final = "exclusive"


Fields = Annotated[dict[str, JsonValue], WithJsonSchema({"type": "object"})]


class Control(Section):
    """Who is heard, and what happens when the holder of control is silent."""

    mode: Literal["exclusive"] = Field(default="exclusive", description="One publisher at a time: `gdp control take`.")
    silence_s: float | None = Field(
        default=PROMPT_S, gt=0, le=MINUTE_S, description="Seconds without a message until `stop`. `null`: no limit."
    )
    stop: Fields = Field(
        default_factory=dict, description="Message published here then, once; missing fields are zero or empty."
    )


def _control(value: object) -> object:
    return {"mode": value} if isinstance(value, str) else value


SomeControl = Annotated[Control | None, BeforeValidator(_control), or_short({"const": EXCLUSIVE})]
