"""The pretended price list of the provider ``local``, so that choice, cost and budget can be tried out for nothing.

Place: pure. Nobody pays these prices: 1 cent for a virtual CPU and an hour, 10 cents for a GPU, 60 % less as spot, and
a little more from region to region, so that there is a cheapest one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from fog.hardware import GPUS, Hardware
from fog.offer import Offer

__all__ = ["LOCAL_REGIONS", "local_offers"]

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


def local_offers(regions: Sequence[str] = LOCAL_REGIONS) -> Iterator[Offer]:
    """Give every type in every region, also in those of other providers, which ``local`` can pretend to have."""
    for place, region in enumerate(regions):
        for name, has in _TYPES.items():
            usd = (has.cpus * _USD_PER_CPU + has.gpus * _USD_PER_GPU) * (1 + place * _DEARER)
            yield Offer("local", region, name, has, is_spot=False, usd_per_hour=round(usd, 4))
            yield Offer("local", region, name, has, is_spot=True, usd_per_hour=round(usd * _SPOT, 4))
