"""Cache of a provider's offers; entries are valid for one minute.

I/O; queries the provider.
"""

from __future__ import annotations

from typing import Final

from fog.cluster import MachineRequest
from fog.latency.known import Latencies
from fog.offer import Offer
from fog.providers.provider import Provider

__all__ = ["OfferCache"]

_OFFERS_S: Final = 60.0  # validity of a price list


class OfferCache:
    """Offers by machine request."""

    def __init__(self, latencies: Latencies) -> None:
        self.latencies = latencies
        self._offers: dict[MachineRequest, tuple[float, list[Offer]]] = {}

    def clear(self) -> None:
        """Drop all offers."""
        self._offers.clear()

    def get(self, provider: Provider, wanted: MachineRequest, now_s: float) -> list[Offer]:
        """Return the provider's offers for a request, at most one minute old."""
        at_s, offers = self._offers.get(wanted, (0.0, []))
        if now_s - at_s >= _OFFERS_S or not offers:
            offers = provider.offers(wanted.hardware, spot=wanted.is_spot)
            self._offers[wanted] = now_s, offers
            self.latencies.refresh_in_background((each.region for each in offers), now_s)
        return offers
