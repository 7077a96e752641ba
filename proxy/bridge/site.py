"""What every flow of a bridge works with.

Place: shell.
"""

from __future__ import annotations

from dataclasses import dataclass

from gdp.client.member import Member
from proxy.faults import Faults
from proxy.traffic import Traffic

__all__ = ["Site"]


@dataclass(frozen=True, slots=True)
class Site:
    """One proxy: its hold on the overlay, what it has carried, and where its faults are told."""

    member: Member
    traffic: Traffic
    faults: Faults
