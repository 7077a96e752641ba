"""Offers of a provider, kept for a minute each.

I/O; asks the provider.
"""

from __future__ import annotations

from typing import Final

from fog.cluster import MachineRequest
from fog.latency.known import Latencies
from fog.offer import Offer
from fog.providers.provider import Provider

__all__ = ["OfferCache"]

_OFFERS_S: Final = 60.0  # a price list holds


class OfferCache:
    """Offers by what is wanted.

    Args:
        latencies: of regions; measured in the background for regions that have offers.
    """

    def __init__(self, latencies: Latencies) -> None:
        self.latencies = latencies
        self._offers: dict[MachineRequest, tuple[float, list[Offer]]] = {}

    def clear(self) -> None:
        """Drop all offers."""
        self._offers.clear()

    def get(self, provider: Provider, wanted: MachineRequest, now_s: float) -> list[Offer]:
        """Return what the provider offers of what is wanted, at most a minute old."""
        at_s, offers = self._offers.get(wanted, (0.0, []))
        if now_s - at_s >= _OFFERS_S or not offers:
            offers = provider.offers(wanted.hardware, spot=wanted.is_spot)
            self._offers[wanted] = now_s, offers
            self.latencies.refresh_in_background((each.region for each in offers), now_s)
        return offers
