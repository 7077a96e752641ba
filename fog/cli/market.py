"""Offers of a provider for the machines of a plan, latencies of its regions, and the offer chosen for each machine."""

from __future__ import annotations

import difflib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from fog.catalog.measured import measured
from fog.catalog.prices import PROVIDERS, regions_of
from fog.cluster import ClusterPlan, MachineRequest
from fog.hardware import Hardware, Offer
from fog.latency.known import Latencies, Latency
from fog.plan.choice import choose
from fog.plan.target import Target, machines_for
from fog.providers.provider import Provider
from gdp.errors import GdpError, LocalError

_MISSPELLED: Final = 0.9  # of the letters are the same; me-central-1 is not eu-central-1


@dataclass(frozen=True, slots=True)
class Market:
    """Offers and latencies."""

    offers: tuple[Offer, ...]
    latencies: Mapping[str, Latency]

    @property
    def latency_ms(self) -> dict[str, float]:
        """Return the known latencies by region."""
        return {region: each.ms for region, each in self.latencies.items() if each.ms is not None}


def market(provider: Provider, machines: Sequence[MachineRequest], latencies: Latencies) -> Market:
    """Query a provider, and measure the latency of regions where it is unknown."""
    offers: dict[Offer, None] = {}
    asked = [(each.hardware, is_spot) for each in machines for is_spot in (True, False) if _is_asked(each, is_spot)]
    for hardware, is_spot in dict.fromkeys(asked):
        offers |= dict.fromkeys(provider.offers(hardware, spot=is_spot))
    regions = list(dict.fromkeys(offer.region for offer in offers))
    latencies.refresh(regions, time.time())
    return Market(tuple(offers), latencies.lookup(regions, time.time()))


def _is_asked(wanted: MachineRequest, is_spot: bool) -> bool:
    return is_spot == wanted.is_spot or wanted.may_be_on_demand


def in_regions(machines: Sequence[MachineRequest], regions: Sequence[str]) -> tuple[MachineRequest, ...]:
    """Return the machines in these regions, in turn, whatever the launch file says; unchanged if there are none.

    Raises:
        LocalError: a region is misspelled; ``local`` simulates any that is not close to a known one.
    """
    if regions:
        machines = [replace(each, region=regions[at % len(regions)]) for at, each in enumerate(machines)]
    known = [region for provider in PROVIDERS for region in regions_of(provider)]
    for name in dict.fromkeys(each.region for each in machines):
        near = difflib.get_close_matches(letters := _letters(name), map(_letters, known), 1, _MISSPELLED)
        if near and near[0] != letters:  # another number is another region
            meant = difflib.get_close_matches(name, (each for each in known if _letters(each) == near[0]), 1, 0)
            raise LocalError(f"no region is called {name}; did you mean {meant[0]}?")
    return tuple(machines)


def _letters(region: str) -> str:
    """Return a region's name without its provider and numbers."""
    return "".join(filter(str.isalpha, region.rpartition("/")[2]))


def reached(plan: ClusterPlan, found: Market) -> tuple[ClusterPlan, Target | None]:
    """Return a plan with the machines that its availability needs, and the result; None: it has no availability."""
    if plan.availability is None:
        return plan, None
    target = machines_for(plan.availability, plan.machines, found.offers, measured(), found.latency_ms)
    return replace(plan, machines=target.machines, availability=None), target


def choices(found: Market, machines: Sequence[MachineRequest]) -> list[Offer | None]:
    """Return the offer chosen for each machine; None: no offer fits."""
    chosen: list[Offer | None] = []
    for each in machines:
        used = [offer.region for offer in chosen if offer is not None]
        try:
            chosen.append(choose(found.offers, [each], found.latency_ms, used=used)[0].offer)
        except LocalError:
            chosen.append(_on_demand(found, each, used))
    return chosen


def _on_demand(found: Market, wanted: MachineRequest, used: Sequence[str]) -> Offer | None:
    """Return the offer on demand that takes the place of a spot machine."""
    if not wanted.may_be_on_demand:
        return None
    try:
        return choose(found.offers, [wanted.on_demand()], found.latency_ms, used=used)[0].offer
    except LocalError:
        return None


def refusal(provider: Provider, machines: Sequence[MachineRequest], chosen: Sequence[Offer | None]) -> str:
    """Return why no offer fits a machine, and the nearest offer."""
    missing = next(each for each, offer in zip(machines, chosen, strict=True) if offer is None)
    try:
        everything = [offer for spot in (True, False) for offer in provider.offers(Hardware(), spot=spot)]
        choose(everything, [missing])
    except GdpError as error:
        return str(error)
    return f"{missing.hardware.to_text()}: not to be had"
