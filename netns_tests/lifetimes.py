"""Running time of real topologies, compared with the leases of their names.

A test that ends within the first lease proves nothing about renewal: its result may change a moment later.
"""

from __future__ import annotations

from dataclasses import dataclass

import pytest

LEASES = 3
LEASE_S = 2.0  # requested by tests with real processes, so that three leases pass quickly


@dataclass(frozen=True, slots=True)
class Lifetime:
    """Topology with the lease of its names and the seconds for which it carried traffic."""

    what: str
    lease_s: float
    lasted_s: float

    @property
    def short_s(self) -> float:
        """Return how many seconds three leases still need."""
        return LEASES * self.lease_s - self.lasted_s


noted: list[Lifetime] = []  # of the test that runs


def too_short(lifetimes: list[Lifetime], marker: pytest.Mark | None) -> str:
    """Return why a test does not outlive its leases; empty if it does, or does not have to."""
    if marker is not None:
        reasons = [reason for reason in marker.args if isinstance(reason, str) and reason.strip()]
        return "" if reasons else "momentary needs a reason: why does no lease matter here?"
    return "".join(
        f"{each.what} carried traffic for {each.lasted_s:.1f} s, {each.short_s:.1f} s less than {LEASES} leases: let it"
        " last longer, make its leases shorter, or mark the test momentary and say why no lease matters. "
        for each in lifetimes
        if each.short_s > 0
    )
