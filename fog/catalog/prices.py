"""Lookup in the price lists that this package ships.

I/O; reads files of this package only.
"""

from __future__ import annotations

from collections.abc import Sequence

from fog.catalog.aws import aws_offers
from fog.catalog.local import LOCAL_REGIONS, local_offers
from fog.hardware import Hardware, Offer
from gdp.errors import LocalError

PROVIDERS = ("local", "aws")


def price_list(
    provider: str, hardware: Hardware, *, spot: bool | None = None, regions: Sequence[str] = ()
) -> list[Offer]:
    """Return the offers with enough hardware, cheapest first; empty if there are none.

    Args:
        spot: only spot machines, or only on-demand machines; None: both.
        regions: only these; ``local`` simulates any region listed here.

    Raises:
        LocalError: no such provider.
    """
    return sorted(
        (
            offer
            for offer in _all(provider, regions)
            if hardware.fits(offer.hardware)
            and spot in (None, offer.is_spot)
            and (not regions or offer.region in regions)
        ),
        key=lambda offer: (offer.usd_per_hour, offer.region, offer.type_name),
    )


def regions_of(provider: str) -> tuple[str, ...]:
    """Return the regions of a provider's list."""
    return tuple(dict.fromkeys(offer.region for offer in _all(provider, ())))


def _all(provider: str, regions: Sequence[str]) -> list[Offer]:
    match provider:
        case "local":
            return list(local_offers(regions or LOCAL_REGIONS))
        case "aws":
            return list(aws_offers())
    raise LocalError(f"no price list of {provider!r} here: expected one of {', '.join(PROVIDERS)}")
