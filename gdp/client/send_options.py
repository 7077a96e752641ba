"""Send options of one topic: how fresh, how much and how often its messages leave.

Sans-I/O.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["SendOptions"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SendOptions:
    """How messages of a topic share the path.

    Attributes:
        deadline_s: a best-effort message that cannot leave whole within this time is dropped (ROS 2: lifespan). None: a
            message that waits is dropped when a newer one waits, too.
        weight: share of the path, next to other topics of the same priority.
        max_bits_s: most bits of frames per second; None: what the path carries.
        repairs: lost parts of a best-effort message are sent again while that can be in time.
    """

    deadline_s: float | None = None
    weight: int = 1
    max_bits_s: float | None = None
    repairs: bool = True
