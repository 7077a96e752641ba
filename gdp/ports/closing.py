"""Closing in another thread: the kernel takes 8 to 30 ms (a grace period of RCU) for a packet socket or a bpf link.

A port has seven of them. Without it, a switch would do nothing for 100 ms whenever a robot leaves it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack


class Closing:
    """What a plane has given up, and the kernel still holds."""

    def __init__(self) -> None:
        self._threads: list[tuple[str, threading.Thread]] = []  # each with its device

    def close(self, ifname: str, closes: Sequence[Callable[[], object]]) -> None:
        """Call these, which belong to one device, one after the other in a thread, whatever one raises."""
        if not closes:
            return
        stack = ExitStack()
        for close in reversed(closes):
            stack.callback(close)
        thread = threading.Thread(target=stack.close, name="closing", daemon=True)
        self._threads.append((ifname, thread))
        thread.start()

    def wait(self, ifname: str | None = None) -> None:
        """Wait until a device, or all, is closed, as it must be before it is opened again."""
        for name, thread in self._threads:
            if ifname in (None, name):
                thread.join()
        self._threads = [each for each in self._threads if each[1].is_alive()]
