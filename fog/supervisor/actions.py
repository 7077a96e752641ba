"""What a provider is asked to do, each in a thread of its own, so that no slow one keeps the supervisor from looking.

I/O.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

from gdp.errors import GdpError

__all__ = ["ActionRunner", "Done"]

_MAX: Final = 8  # at once


@dataclass(frozen=True, slots=True)
class Done:
    """An act that is over.

    Args:
        result: what the provider said; empty where there is nothing to say.
        error: why it failed.
    """

    cluster: str
    machine: str
    what: str
    result: str
    error: GdpError | None


class ActionRunner:
    """Acts under way, one a machine.

    Args:
        wake: called when one is over, from its thread.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._threads = ThreadPoolExecutor(_MAX, "act")
        self._futures: dict[tuple[str, str], tuple[str, Future[str | None]]] = {}

    def begin(self, cluster: str, machine: str, what: str, act: Callable[[], str | None]) -> None:
        """Do something about a machine about which nothing else is being done."""
        future = self._threads.submit(act)
        self._futures[cluster, machine] = what, future
        future.add_done_callback(lambda _: self._wake())

    def is_busy(self, cluster: str, machine: str = "") -> bool:
        """Return whether something is being done about a machine, or without one about any of the cluster."""
        return any(key == (cluster, machine) or (not machine and key[0] == cluster) for key in self._futures)

    @property
    def running(self) -> int:
        """Return how many acts are not over."""
        return sum(not future.done() for _, future in list(self._futures.values()))

    def poll_done(self) -> list[Done]:
        """Return, once, what is over. An error that is none of ours is raised."""
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
        """Wait until all is over."""
        self._threads.shutdown(wait=True)
