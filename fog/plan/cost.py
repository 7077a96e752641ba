"""Comparison of costs per hour and month, in the form of the paper's Table I."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from fog.hardware import Offer

HOURS_A_MONTH: Final = 730.0  # 365 days of 24 hours, over 12


@dataclass(frozen=True, slots=True)
class Bill:
    """Configuration and its price; ``of_single``: ratio of its price to that of a single on-demand machine."""

    what: str
    usd_per_hour: float
    of_single: float

    @property
    def usd_per_month(self) -> float:
        """Return the price of a month of continuous operation."""
        return self.usd_per_hour * HOURS_A_MONTH


def compared(on_demand: Offer, spot: Offer) -> tuple[Bill, Bill, Bill]:
    """Return the bills of one on-demand machine, two on-demand machines, and two spot machines."""
    single = on_demand.usd_per_hour
    rows = (
        ("one on-demand machine", single),
        ("two on-demand machines", 2 * single),
        ("two spot machines", 2 * spot.usd_per_hour),
    )
    one, two, two_spot = (Bill(what, usd, usd / single if single else 1.0) for what, usd in rows)
    return one, two, two_spot
