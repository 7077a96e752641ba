"""Events of clusters and machines: derived from records before and after an observation, and logged.

I/O: the journal, for ``fog status --events``, and the process log.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from typing import NamedTuple

from fog.machine import Machine, MachineState
from fog.supervisor.core.record import Record
from fog.supervisor.journal import Journal

log = logging.getLogger(__name__)


class EventLog:
    """Writer of events of clusters and machines; it writes each trouble once until it is cleared."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._troubles: dict[str, str] = {}

    def put(self, record: Record, what: str, detail: str, now_s: float, since_unix_s: float | None = None) -> None:
        """Store a machine's record, with the event if ``what`` names one; ``since_unix_s``: time of the event."""
        self._journal.put(record, now_s, what, detail, since_unix_s)
        if what:
            log.info("machine %s cluster=%s machine=%s %s", what, record.spec.cluster, record.name, detail)

    def add_trouble(self, cluster: str, reason: str, *, key: str = "") -> None:
        """Write a trouble of a cluster once; ``key`` distinguishes troubles of one cluster."""
        if self._troubles.get(key or cluster) != reason:
            self._troubles[key or cluster] = reason
            self._journal.write_event(time.time(), cluster, "", "trouble", reason)
            log.warning("trouble cluster=%s reason=%s", cluster, reason)

    def clear_trouble(self, key: str) -> None:
        """Record that a trouble has ended."""
        self._troubles.pop(key, None)

    def has_trouble(self, key: str) -> bool:
        """Return whether a trouble lasts."""
        return key in self._troubles


class Change(NamedTuple):
    """Event; ``since_unix_s``: its time, if the machine's or the provider's records contain it."""

    what: str
    detail: str
    since_unix_s: float | None = None


def changes(before: Record, after: Record, seen: Machine | None, now_s: float) -> Iterator[Change]:
    """Yield the events between two records."""
    since = f"{now_s - after.asked_unix_s:.1f} s after it was asked for"
    if before.up_unix_s is None and after.up_unix_s is not None:
        yield Change("running", since)
    if before.noticed_unix_s is None and after.noticed_unix_s is not None:
        leaves_in_s = (after.leaves_at_unix_s or now_s) - now_s
        yield Change("notice", f"{after.reason}; leaves in {leaves_in_s:.1f} s", _since(seen, MachineState.LEAVING))
    if before.served_unix_s is None and after.served_unix_s is not None:
        yield Change("serving", since)
    elif before.unreachable_unix_s is not None and after.unreachable_unix_s is None and not after.is_gone:
        yield Change("serving", f"again, after {now_s - before.unreachable_unix_s:.1f} s")
    is_lost = before.unreachable_unix_s is None and after.unreachable_unix_s is not None
    if after.served_unix_s is not None and is_lost and not after.is_released and after.drained_unix_s is None:
        yield Change("unreachable", "its replica is not heard in the overlay")
    if not before.is_gone and after.is_gone:
        what = after.ending.value if after.ending is not None else "gone"
        yield Change(what, after.reason, _since(seen, MachineState.GONE))


def _since(seen: Machine | None, state: MachineState) -> float | None:
    return seen.since_unix_s if seen is not None and seen.state is state else None
