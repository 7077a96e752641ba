"""Busy polling: the decision whether to poll for a moment before the thread sleeps.

Sans-I/O; time comes in as seconds. The kernel wakes a sleeping process within 30 to 60 us, and often later on a virtual
machine. A small message crosses three switches in that time. If frames follow each other closely, polling for about
that long pays; otherwise it only costs power. So a node polls only while more than half of the last waits were short
enough (compare the kernel's ``halt_poll_ns`` for idle virtual processors).
"""

from __future__ import annotations

from typing import Final

SPIN_US: Final = 300
SPIN_MAX_US: Final = 10_000
_WEIGHT: Final = 1 / 8  # of the newest wait
_PAYS: Final = 0.5


class BusyPoll:
    """Statistics of recent waits.

    Args:
        longest_s: longest time to poll; 0: never.
    """

    __slots__ = ("_short", "longest_s")

    def __init__(self, longest_s: float) -> None:
        self.longest_s = longest_s
        self._short = 0.0  # share of the last waits that polling would have caught

    @property
    def pays(self) -> bool:
        """Return whether the next wait will probably be a short one."""
        return self._short > _PAYS

    def waited(self, seconds: float) -> None:
        """Record how long the wait for the last frames was."""
        self._short += (float(seconds < self.longest_s) - self._short) * _WEIGHT
