"""Simulated price list of the provider ``local``, to test choice, cost and budget free of charge.

Sans-I/O. No one is charged. Prices per hour: 1 cent for a virtual CPU, 10 cents for a GPU, 60 % less for spot machines.
They rise slightly from region to region, so one region is the cheapest.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from fog.hardware import GPUS, Hardware, Offer

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
    """Yield every type in every region; ``local`` can also simulate regions of other providers."""
    for place, region in enumerate(regions):
        for name, has in _TYPES.items():
            usd = (has.cpus * _USD_PER_CPU + has.gpus * _USD_PER_GPU) * (1 + place * _DEARER)
            yield Offer("local", region, name, has, is_spot=False, usd_per_hour=round(usd, 4))
            yield Offer("local", region, name, has, is_spot=True, usd_per_hour=round(usd * _SPOT, 4))
