"""Whether a cluster is used: how many requests its machines' proxies say they have had.

Place: pure.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

__all__ = ["Activity", "requests_in"]


def requests_in(log: str) -> int | None:
    """Return how many messages a proxy (``gdp-proxy --json``) had had when it last said so; None: it says nothing."""
    for line in reversed(log.splitlines()):
        if not line.startswith('{"event":"progress"'):
            continue
        try:
            return int(json.loads(line)["received"])
        except (ValueError, KeyError, TypeError):
            continue  # cut off
    return None


class Activity:
    """Since when nobody has called."""

    def __init__(self, begun_unix_s: float) -> None:
        self._since_s = begun_unix_s
        self._counts: dict[str, int] = {}

    def idle_s(self, counts: Mapping[str, int | None], now_s: float) -> float:
        """Take in what each machine's proxy said, and return for how long none has had a request.

        A machine that cannot be asked counts as used: nothing is ended on a guess.
        """
        for machine, count in counts.items():
            if count is None or count > self._counts.get(machine, 0):
                self._since_s = now_s
            if count is not None:
                self._counts[machine] = count
        return now_s - self._since_s
