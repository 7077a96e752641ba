"""Price lists that this package ships, and the lookup in them.

I/O; reads files of this package only. ``git show 55cf6b3c:scripts/make_catalog.py`` generated the list of AWS EC2 for
Linux: on-demand list prices, and spot machines at their published savings. The file states its sources and their date.
A price that is not known for certain is absent, not estimated.
The list of the provider ``local`` is simulated, to test choice, cost and budget free of charge. Prices per hour: 1 cent
for a virtual CPU, 10 cents for a GPU, 60 % less for spot machines. They rise slightly from region to region, so one
region is the cheapest.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Final

from fog.hardware import GPUS, Hardware, Offer
from gdp.errors import LocalError

LOCAL_REGIONS: Final = ("local-a", "local-b", "local-c", "local-d")

_TYPES: Final = {
    "local.small": Hardware(2, 4.0),
    "local.medium": Hardware(4, 16.0),
    "local.large": Hardware(16, 64.0),
    "local.huge": Hardware(64, 256.0),
    **{f"local.{model.lower()}": Hardware(8, 32.0, model, 1) for model in GPUS},
    **{f"local.{model.lower()}x8": Hardware(96, 768.0, model, 8) for model in GPUS},
}
_USD_PER_CPU, _USD_PER_GPU, _SPOT, _DEARER = 0.01, 0.10, 0.4, 0.02
PROVIDERS = ("local", "aws")


def local_offers(regions: Sequence[str] = LOCAL_REGIONS) -> Iterator[Offer]:
    """Yield every type in every region; ``local`` can also simulate regions of other providers."""
    for place, region in enumerate(regions):
        for name, has in _TYPES.items():
            usd = (has.cpus * _USD_PER_CPU + has.gpus * _USD_PER_GPU) * (1 + place * _DEARER)
            yield Offer("local", region, name, has, is_spot=False, usd_per_hour=round(usd, 4))
            yield Offer("local", region, name, has, is_spot=True, usd_per_hour=round(usd * _SPOT, 4))


@dataclass(frozen=True, slots=True)
class AwsPrices:
    """Price list.

    Args:
        bands: description of each interruption band, such as ``>20%`` of machines a month.
        band: by region and type, an index into ``bands``.
    """

    offers: tuple[Offer, ...]
    sources: tuple[str, ...]
    bands: tuple[str, ...]
    band: dict[tuple[str, str], int]


@functools.cache
def aws_prices() -> AwsPrices:
    """Return the list; the file is read once per process."""
    items = json.loads(resources.files("fog.catalog").joinpath("aws.json").read_bytes())
    types = {name: Hardware(*has) for name, has in items["types"].items()}
    offers: list[Offer] = []
    band: dict[tuple[str, str], int] = {}
    for region, prices in items["regions"].items():
        for name, (usd, savings_percent, interruptions) in prices.items():
            offers.append(Offer("aws", region, name, types[name], is_spot=False, usd_per_hour=usd))
            if savings_percent is not None:
                spot = round(usd * (1 - savings_percent / 100), 5)
                offers.append(Offer("aws", region, name, types[name], is_spot=True, usd_per_hour=spot))
                band[region, name] = interruptions
    return AwsPrices(tuple(offers), tuple(items["sources"]), tuple(items["bands"]), band)


def aws_offers() -> Iterator[Offer]:
    """Yield every offer of the list."""
    yield from aws_prices().offers


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
