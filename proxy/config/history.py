"""History of a rule: what a publisher keeps for late joiners, or an importer asks a holder for.

Section of a configuration file.
"""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import BeforeValidator, Field
from pydantic.config import JsonDict

from gdp.client.send_options import HISTORY_BYTES_MAX, HISTORY_MESSAGES_MAX
from gdp.config.schema import Section, or_short
from gdp.intervals import DAY_S
from proxy.config.keep import Services


class History(Section):
    """Bounds of what is kept; the first that is reached counts."""

    messages: int = Field(default=HISTORY_MESSAGES_MAX, ge=1, le=HISTORY_MESSAGES_MAX, description="Most messages.")
    max_bytes: int = Field(
        default=8 << 20, alias="bytes", ge=1, le=HISTORY_BYTES_MAX, description="Most bytes, as they travel."
    )
    store: Services | None = Field(
        default=None, min_length=1, description="Imported topics: services of holders; the nearest is read."
    )
    age_s: float | None = Field(default=None, gt=0, le=DAY_S, description="Longest time in seconds. `null`: any.")


def _history(value: object) -> object:
    if value == "from-store":
        return {"store": "store"}
    return {"messages": value} if isinstance(value, int) and not isinstance(value, bool) else value


_COUNT: Final[JsonDict] = {"type": "integer", "minimum": 1, "maximum": HISTORY_MESSAGES_MAX}


SomeHistory = Annotated[History | None, BeforeValidator(_history), or_short(_COUNT, {"const": "from-store"})]
