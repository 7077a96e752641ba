"""Activity of a cluster, computed from message counters of proxies."""

from __future__ import annotations

from collections.abc import Mapping


class Activity:
    """Time since the last call of a cluster, or since it was first observed."""

    def __init__(self, begun_unix_s: float) -> None:
        self._since_s = begun_unix_s
        self._counts: dict[str, int] = {}

    def idle_s(self, counts: Mapping[str, int | None], now_s: float) -> float:
        """Update the counter of each proxy, and return for how many seconds none has grown.

        A proxy that does not respond counts as used, so a cluster never ends without evidence.
        """
        for proxy, count in counts.items():
            if count is None or count > self._counts.get(proxy, 0):
                self._since_s = now_s
            if count is not None:
                self._counts[proxy] = count
        return now_s - self._since_s
