"""Runner of provider calls, each in its own thread, so that a slow call does not block reconciliation.

I/O.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

from gdp.errors import GdpError

__all__ = ["ActionRunner", "Done"]

_MAX: Final = 8  # concurrent actions


@dataclass(frozen=True, slots=True)
class Done:
    """Finished action; ``result``: result of the provider; empty if there is none."""

    cluster: str
    machine: str
    what: str
    result: str
    error: GdpError | None


class ActionRunner:
    """Running actions, at most one per machine; ``wake``: called when an action has ended, from its thread."""

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._threads = ThreadPoolExecutor(_MAX, "act")
        self._futures: dict[tuple[str, str], tuple[str, Future[str | None]]] = {}

    def begin(self, cluster: str, machine: str, what: str, act: Callable[[], str | None]) -> None:
        """Begin an action on a machine that is not busy."""
        future = self._threads.submit(act)
        self._futures[cluster, machine] = what, future
        future.add_done_callback(lambda _: self._wake())

    def is_busy(self, cluster: str, machine: str = "") -> bool:
        """Return whether an action runs on a machine, or without a machine on any of the cluster."""
        return any(key == (cluster, machine) or (not machine and key[0] == cluster) for key in self._futures)

    @property
    def running(self) -> int:
        """Return the number of actions that have not ended."""
        return sum(not future.done() for _, future in list(self._futures.values()))

    def poll_done(self) -> list[Done]:
        """Return each finished action once. An error other than ``GdpError`` is raised."""
        over = [(key, what, future) for key, (what, future) in self._futures.items() if future.done()]
        found = []
        for key, what, future in over:
            del self._futures[key]
            error = future.exception()
            if error is not None and not isinstance(error, GdpError):
                raise error
            found.append(Done(*key, what, (future.result() or "") if error is None else "", error))
        return found

    def close(self) -> None:
        """Wait until all actions have ended."""
        self._threads.shutdown(wait=True)
