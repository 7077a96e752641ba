"""RIBs of the tiers below: whether a lease that one of them does not renew has ended, or the RIB itself is gone.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A lease ends with its advertiser only where the RIB that
relayed the advertisement is alive: it answers a probe. The routes of a silent RIB are kept, as those of a silent tier
above are (RFC 8767 in spirit). A RIB that is back has half a lease to relay them again.
"""

from __future__ import annotations

from dataclasses import dataclass

from gdp.intervals import ADVERTISEMENT, NEVER_S
from gdp.names import Name
from gdp.rib.upstream_advertisements import QUIET_S


@dataclass(slots=True)
class _Rib:
    probed_s: float = -NEVER_S
    heard_s: float = -NEVER_S
    returned_s: float = -NEVER_S
    is_silent: bool = False


class LowerRibs:
    """What probes say of the RIBs whose routes lapsed; others are not recorded."""

    def __init__(self) -> None:
        self._ribs: dict[Name, _Rib] = {}

    def record_alive(self, rib: Name, now_s: float) -> None:
        """Record a sign of life."""
        known = self._ribs.get(rib)
        if known is not None:
            known.heard_s = now_s
            if known.is_silent:
                known.is_silent, known.returned_s = False, now_s

    def keep_s(self, rib: Name, now_s: float) -> float:
        """Return for how many seconds to keep a route that a RIB did not renew; 0: the RIB is alive, the lease ends."""
        known = self._ribs.setdefault(rib, _Rib())
        since_s = now_s - known.probed_s
        if known.heard_s < known.probed_s and since_s >= QUIET_S:
            known.is_silent = True
        if known.is_silent:
            return ADVERTISEMENT.lease_s / 2  # it renews within a third
        left_s = known.returned_s + ADVERTISEMENT.lease_s / 2 - now_s
        if left_s > 0.0:
            return left_s
        return 0.0 if known.heard_s >= known.probed_s and since_s <= 2 * QUIET_S else QUIET_S

    def is_probe_due(self, rib: Name, now_s: float) -> bool:
        """Return whether to probe a RIB whose routes are kept; that counts as done."""
        known = self._ribs.setdefault(rib, _Rib())
        is_due = now_s - known.probed_s >= QUIET_S
        if is_due:
            known.probed_s = now_s
        return is_due
