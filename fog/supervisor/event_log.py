"""Log of events of clusters and machines, in the journal and in the process log."""

from __future__ import annotations

import logging
import time

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
