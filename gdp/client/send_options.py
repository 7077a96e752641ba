"""Send options of one topic: how fresh, how much and how often its messages leave.

Sans-I/O.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gdp.errors import LocalError

__all__ = [
    "DEADLINE_MAX_S",
    "DEFAULT_OPTIONS",
    "RATE_MAX_BITS_S",
    "RATE_MIN_BITS_S",
    "WEIGHT_MAX",
    "SendOptions",
    "checked",
]

DEADLINE_MAX_S: Final = 3_600.0
WEIGHT_MAX: Final = 100
RATE_MIN_BITS_S: Final = 1_000.0  # less would carry a frame of 1,500 bytes in more than 12 s
RATE_MAX_BITS_S: Final = 1e12


@dataclass(frozen=True, slots=True, kw_only=True)
class SendOptions:
    """How messages of a topic share the path.

    Attributes:
        deadline_s: a best-effort message that cannot leave whole within this time is dropped (ROS 2: lifespan). None: a
            message that waits is dropped when a newer one waits, too.
        weight: share of the path, next to other topics of the same priority.
        max_bits_s: most bits of frames per second; None: what the path carries.
        fec: messages are sent redundantly against loss that is measured.
        repairs: lost parts of a best-effort message are sent again while that can be in time.
    """

    deadline_s: float | None = None
    weight: int = 1
    max_bits_s: float | None = None
    repairs: bool = True
    fec: bool = True


DEFAULT_OPTIONS: Final = SendOptions()


def checked(options: SendOptions) -> SendOptions:
    """Return the options.

    Raises:
        LocalError: one of them is out of bounds.
    """
    deadline_s, weight, max_bits_s = options.deadline_s, options.weight, options.max_bits_s
    if deadline_s is not None and not 0 < deadline_s <= DEADLINE_MAX_S:
        raise LocalError(f"deadline_s is above 0 and at most {DEADLINE_MAX_S:g} s, not {deadline_s!r}")
    if not isinstance(weight, int) or not 1 <= weight <= WEIGHT_MAX:
        raise LocalError(f"weight is a whole number from 1 to {WEIGHT_MAX}, not {weight!r}")
    if max_bits_s is not None and not RATE_MIN_BITS_S <= max_bits_s <= RATE_MAX_BITS_S:
        raise LocalError(
            f"max_bits_s is at least {RATE_MIN_BITS_S:g} and at most {RATE_MAX_BITS_S:g}, not {max_bits_s!r}"
        )
    return options
