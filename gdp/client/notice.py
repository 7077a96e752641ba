"""What readers must know to understand a topic's messages, and when it is to be said again.

Place: pure; time comes in as ``now_s`` (monotonic seconds).

A new reader asks until it is told. Those that read already do not know that there is news, and nothing confirms a
status: so news is said several times, at growing distances.
"""

from __future__ import annotations

from typing import Final

__all__ = ["Notice"]

_PAUSES_S: Final = (0.05, 0.2, 0.8, 3.2)  # after each saying but the last


class Notice:
    """A publisher's description, ``text``."""

    def __init__(self, text: bytes) -> None:
        self.text = text
        self._said = len(_PAUSES_S) + 1  # times; it is no news
        self._again_s = float("inf")

    def change(self, text: bytes) -> bool:
        """Take a description; return whether it is another, to be said at once."""
        if text == self.text:
            return False
        self.text, self._said = text, 0
        return True

    def due(self) -> float | None:
        """Return the monotonic second at which it is to be said again, or None."""
        return None if self._again_s == float("inf") else self._again_s

    def say(self, now_s: float, *, is_asked: bool) -> bytes:
        """Return what a status says now: the text where somebody asks or where it is news, else nothing."""
        is_news = self._said <= len(_PAUSES_S)
        if is_news:
            left = self._said < len(_PAUSES_S)
            self._again_s = now_s + _PAUSES_S[self._said] if left else float("inf")
            self._said += 1
        return self.text if is_asked or is_news else b""
