"""Whether to look again for a moment before going to sleep.

Place: pure; time comes in as seconds. A sleeping process is woken within 30 to 60 us, on a virtual machine often later:
as long as a small message takes over three switches. Where frames follow each other closely it pays to keep looking
for about as long; where they do not it would only cost power. So it is tried only while more than half of the last
waits were short enough (compare the kernel's ``halt_poll_ns`` for idle virtual processors).
"""

from __future__ import annotations

from typing import Final

__all__ = ["SPIN_MAX_US", "SPIN_US", "BusyPoll"]

SPIN_US: Final = 300
SPIN_MAX_US: Final = 10_000
_WEIGHT: Final = 1 / 8  # of the newest wait
_PAYS: Final = 0.5


class BusyPoll:
    """Remembers how waits went.

    Args:
        longest_s: how long to keep looking; 0: never.
    """

    __slots__ = ("_short", "longest_s")

    def __init__(self, longest_s: float) -> None:
        self.longest_s = longest_s
        self._short = 0.0  # share of the last waits that spinning would have caught

    @property
    def pays(self) -> bool:
        """Return whether the next wait will probably be a short one."""
        return self._short > _PAYS

    def waited(self, seconds: float) -> None:
        """Learn how long the wait for the last frames was."""
        self._short += (float(seconds < self.longest_s) - self._short) * _WEIGHT
