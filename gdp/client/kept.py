"""A send window that goes on where another one of the same life ended, and may change how much it keeps.

Place: pure.
"""

from __future__ import annotations

from gdp.message.window import SendWindow

__all__ = ["Kept"]


class Kept(SendWindow):
    """What a publisher keeps.

    Args:
        keep_last: messages that are kept for late joiners, acknowledged or not.
        newest: the highest number that was used before.
        lag_s: as for every window.
    """

    def __init__(self, keep_last: int, newest: int, lag_s: float) -> None:
        super().__init__(keep_last, lag_s=lag_s)
        self._newest = newest

    def keep(self, last: int, newest: int) -> None:
        """Keep another number of messages from now on; ``newest`` is the highest number used, here or elsewhere."""
        self._keep_last = last
        self._newest = max(self._newest, newest)
        self._release_acknowledged()
