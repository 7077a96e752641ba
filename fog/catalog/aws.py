"""Price list of AWS EC2 for Linux, as shipped: on-demand list prices, and spot machines at their published savings.

I/O; reads one file of this package. ``scripts/make_catalog.py`` generates it; the file states its sources and their
date. A price that is not known for certain is absent, not estimated.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources

from fog.hardware import Hardware, Offer


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
