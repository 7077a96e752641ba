"""Local faults of the things that rules name: each occurrence is counted, only the first is logged.

I/O: it logs. A warning contains the local topic name, on the machine that owns the topic and nowhere else. A fault that
persists is logged again with its count at a thousand, ten thousand and so on. A detail may contain text of a remote
node: it is escaped and truncated.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from enum import Enum
from typing import Final

from gdp.printable import printable

log = logging.getLogger(__name__)

_COUNTS_MAX: Final = 4_096
_COUNT_LOGGED: Final = 1_000  # the first count that is logged


class Fault(str, Enum):
    """Reason why something is not carried, or not as it should be. The value is the metric's label."""

    NO_DELEGATION = "no-delegation"
    UNKNOWN_TYPE = "unknown-type"  # this machine, or this ROS version, has no such type
    OTHER_TYPE = "other-type"  # differs from the rule's type, or definitions differ
    QOS = "qos"  # a local reader or publisher whose QoS cannot match
    TOO_LARGE = "too-large"
    TOO_FAST = "too-fast"  # the path does not keep up
    UNCONFIRMED = "unconfirmed"  # readers had not confirmed all when it ended
    MALFORMED = "malformed"  # bytes that do not fit their definition
    NO_GRAPH = "no-graph"  # a master, a domain or a peer is unavailable
    NO_SERVER = "no-server"
    TIMED_OUT = "timed-out"
    REFUSED = "refused"  # a service or the overlay refused
    NO_LIBRARY = "no-library"  # a reduction needs one that this machine lacks
    OTHER_BRIDGE = "other-bridge"  # another proxy of this graph carries it already
    NOT_IN_CONTROL = "not-in-control"  # messages of a publisher that does not hold the control of its topic
    NOT_KEPT = "not-kept"  # a topic's history has a gap, or its holder does not take it
    CLOCK = "clock"  # another machine's clock differs so much that transforms are extrapolated
    INTERNAL = "internal"  # a far party's input provoked an error of this program's own
    QUARANTINED = "quarantined"  # input of a party that did so repeatedly


class Faults:
    """All faults of one proxy."""

    def __init__(self) -> None:
        self._counts: Counter[Fault] = Counter()
        self._reported: dict[tuple[str, Fault], int] = {}
        self._details: dict[tuple[str, Fault], str] = {}  # the newest, of what was reported

    def report(self, what: str, fault: Fault, detail: str) -> None:
        """Count a fault; warn of the first of its kind about ``what``, a local name."""
        self._counts[fault] += 1
        count = self._reported[what, fault] = self._reported.get((what, fault), 0) + 1
        self._details[what, fault] = printable(detail)
        if len(self._reported) > _COUNTS_MAX:
            self._forget(next(iter(self._reported)))
        if count == 1:
            log.warning("%s: %s: %s", printable(what), fault.value, printable(detail))
        elif count >= _COUNT_LOGGED and str(count).strip("0") == "1":
            log.warning("%s: %s: %d times by now", printable(what), fault.value, count)

    def clear(self, what: str, fault: Fault) -> None:
        """Record that a fault is over: the next one is logged again."""
        self._forget((what, fault))

    def of(self, what: str) -> dict[str, tuple[int, str]]:
        """Return the faults of a local name that are not over: by label, how often each came, and its newest detail."""
        found = ((fault, count) for (name, fault), count in self._reported.items() if name == what)
        return {fault.value: (count, self._details[what, fault]) for fault, count in found}

    def _forget(self, key: tuple[str, Fault]) -> None:
        self._reported.pop(key, None)
        self._details.pop(key, None)

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the occurrences by label."""
        return {fault.value: self._counts[fault] for fault in Fault}

    @property
    def total(self) -> int:
        """Return the number of all occurrences."""
        return sum(self._counts.values())
