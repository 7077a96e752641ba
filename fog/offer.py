"""Offer of a provider: a machine type in a region at a price.

Sans-I/O.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

from fog.hardware import Hardware

__all__ = ["Offer"]


@dataclass(frozen=True, slots=True)
class Offer:
    """One line of a price list."""

    provider: str
    region: str
    type_name: str
    hardware: Hardware
    _: KW_ONLY
    is_spot: bool
    usd_per_hour: float
