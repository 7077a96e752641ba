"""Choice of an offer for each replica, by price and measured latency, in different regions if possible.

Sans-I/O. A configurable price of one millisecond makes money and latency comparable.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from fog.cluster import MachineRequest
from fog.hardware import Hardware, Offer
from gdp.errors import LocalError


@dataclass(frozen=True, slots=True)
class Weights:
    """Weights of the choice.

    Args:
        usd_per_hour_per_ms: additional price that one millisecond less latency justifies.
        spreads: whether different regions take precedence over price and latency.
    """

    usd_per_hour_per_ms: float = 0.001
    spreads: bool = True


BY_BOTH: Final = Weights()


@dataclass(frozen=True, slots=True)
class Choice:
    """Chosen offer, and the reason."""

    offer: Offer
    why: str


def choose(
    offers: Sequence[Offer],
    wanted: Sequence[MachineRequest],
    latency_ms: Mapping[str, float] | None = None,
    weights: Weights = BY_BOTH,
    used: Sequence[str] = (),
    avoid: Sequence[str] = (),
) -> list[Choice]:
    """Return one choice for each requested machine, in their order.

    Args:
        latency_ms: of regions, measured from the robot; a region without a figure counts as the slowest measured one.
        used: regions of existing replicas, one entry for each.
        avoid: regions to use only if no other region has an offer, as after a preemption.

    Raises:
        LocalError: no offer fits; the text names the nearest one.
    """
    regions = Counter(used)
    choices: dict[int, Choice] = {}
    # Machines with a fixed region are placed first, so that the others avoid these regions.
    for at in sorted(range(len(wanted)), key=lambda index: not wanted[index].region):
        choice = _best(offers, wanted[at], latency_ms or {}, weights, regions, frozenset(avoid))
        choices[at] = choice
        regions[choice.offer.region] += 1
    return [choices[at] for at in range(len(wanted))]


def _best(
    offers: Sequence[Offer],
    wanted: MachineRequest,
    latency_ms: Mapping[str, float],
    weights: Weights,
    regions: Counter[str],
    avoid: frozenset[str],
) -> Choice:
    allowed = [offer for offer in offers if offer.is_spot == wanted.is_spot and wanted.region in ("", offer.region)]
    fitting = [offer for offer in allowed if wanted.hardware.fits(offer.hardware)]
    if not fitting:
        raise LocalError(_nearest(wanted, allowed, offers))
    slowest_ms = max(latency_ms.values(), default=0.0)

    def order(offer: Offer) -> tuple[bool, int, float, str, str]:
        taken = regions[offer.region] if weights.spreads else 0
        usd_per_hour = offer.usd_per_hour + weights.usd_per_hour_per_ms * latency_ms.get(offer.region, slowest_ms)
        return offer.region in avoid, taken, usd_per_hour, offer.region, offer.type_name

    best = min(fitting, key=order)
    return Choice(best, _why(best, fitting, wanted, latency_ms, regions, avoid))


def _why(
    best: Offer,
    fitting: Sequence[Offer],
    wanted: MachineRequest,
    latency_ms: Mapping[str, float],
    regions: Counter[str],
    avoid: frozenset[str],
) -> str:
    there = {offer.region for offer in fitting}
    places = f"{len(there)} regions" if len(there) > 1 else best.region
    words = [f"lowest of {len(fitting)} offers in {places} by price and latency"]
    if wanted.region:
        words = [f"lowest of {len(fitting)} offers in {wanted.region}, which was asked for"]
    elif regions[best.region]:
        words.append(f"{best.region} has {regions[best.region]} already, as has every other that fits")
    elif taken := sorted(there & regions.keys()):
        words.append(f"away from {', '.join(taken)}")
    if kept := sorted(there & avoid - {best.region}):
        words.append(f"not {', '.join(kept)}, to be avoided now")
    if latency_ms:
        known = latency_ms.get(best.region)
        words.append("latency not measured" if known is None else f"{known:g} ms away")
    if (cheapest := min(offer.usd_per_hour for offer in fitting)) < best.usd_per_hour:
        words.append(f"{best.usd_per_hour - cheapest:.4f} USD an hour above the cheapest")
    return "; ".join(words)


def _nearest(wanted: MachineRequest, allowed: Sequence[Offer], offers: Sequence[Offer]) -> str:
    kind = "spot" if wanted.is_spot else "on-demand"
    asked = f"no {kind} machine with {wanted.hardware.to_text()}" + (f" in {wanted.region}" if wanted.region else "")
    if elsewhere := sorted(
        {o.region for o in offers if o.is_spot == wanted.is_spot and wanted.hardware.fits(o.hardware)}
    ):
        return f"{asked}; there is in {', '.join(elsewhere)}"
    if not allowed:
        return f"{asked}; nothing at all is offered like that"
    near = min(allowed, key=lambda offer: (_lacks(wanted.hardware, offer.hardware), offer.usd_per_hour))
    return f"{asked}; the nearest is {near.type_name} in {near.region} with {near.hardware.to_text()}"


def _lacks(wanted: Hardware, has: Hardware) -> float:
    """Return the shortfall: the sum of the missing amounts, each as a share of the requested amount."""
    gpus = has.gpus if has.gpu == wanted.gpu else has.gpus / 2  # another model is nearer than no GPU
    pairs = ((wanted.cpus, has.cpus), (wanted.memory_gib, has.memory_gib), (wanted.gpus, gpus))
    return math.fsum(max(0.0, 1 - there / want) for want, there in pairs if want)
