"""Placement of the next machine: the best offer, away from other machines and from recent losses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Final

from fog.cluster import MachineRequest
from fog.hardware import Offer
from fog.plan.choice import Choice, choose
from fog.supervisor.core.record import Outcome, Record
from gdp.intervals import HOUR_S
from gdp.requests import Backoff

_WARINESS: Final = Backoff(60.0, 3_600.0)  # by losses
_HOLDS: Final = Backoff(1.0, 300.0)  # by failed requests
_PATIENCE: Final = 4  # after this many consecutive failures in any region, the cause is probably not a region


def place(
    wanted: MachineRequest,
    offers: Sequence[Offer],
    records: Sequence[Record],
    now_s: float,
    latency_ms: Mapping[str, float] | None = None,
) -> Choice | None:
    """Return the chosen offer and the reason. A requested region is replaced if it has just preempted a machine.

    Args:
        offers: with enough hardware.
        records: of the cluster, including machines that are gone.
        latency_ms: of regions, measured from the robot.

    Returns:
        None while all regions with offers failed so recently that it is too early to retry.

    Raises:
        LocalError: no offer fits, now or later.
    """
    if _is_resting(records, now_s):
        return None
    regions = {each.region for each in offers}
    losses = {region: [each for each in records if each.spec.offer.region == region] for region in regions}
    held = {region for region in regions if held_until(losses[region], now_s) > now_s}
    going = {each.spec.offer.region for each in records if each.noticed_unix_s is not None and not each.is_gone}
    avoid = [region for region in regions if region in going or wary_until(losses[region], now_s) > now_s]
    used = [each.spec.offer.region for each in records if not each.is_gone and not each.is_outgoing]
    free = replace(wanted, region="") if wanted.region in {*avoid, *held} else wanted
    open_ = [each for each in offers if each.region not in held]
    if held and not any(free.hardware.fits(each.hardware) and each.is_spot == free.is_spot for each in open_):
        return None
    return choose(open_, [free], latency_ms, used=used, avoid=avoid)[0]


def stopgap(
    wanted: MachineRequest,
    offers: Sequence[Offer],
    records: Sequence[Record],
    now_s: float,
    latency_ms: Mapping[str, float] | None = None,
    *,
    budget_usd_per_h: float | None = None,
) -> Choice | None:
    """Return an offer on demand in place of a spot machine; None: it is too early, or above the budget.

    Args:
        offers: on demand, with enough hardware.
        records: of the cluster; failures of spot machines do not count here.
        budget_usd_per_h: most that all machines may cost in an hour.

    Raises:
        LocalError: no offer fits, now or later.
    """
    counted = [each for each in records if not each.is_gone or not each.spec.offer.is_spot]
    choice = place(wanted.on_demand(), offers, counted, now_s, latency_ms)
    if choice is None or budget_usd_per_h is None:
        return choice
    spent = sum(each.spec.offer.usd_per_hour for each in records if not each.is_gone)
    return choice if spent + choice.offer.usd_per_hour <= budget_usd_per_h else None


def wary_until(records: Iterable[Record], now_s: float) -> float:
    """Return until when a location is avoided because machines were preempted there."""
    lost = _moments(records, Outcome.PREEMPTED, now_s)
    return lost[-1] + _WARINESS.pause_s(len(lost)) if lost else 0.0


def held_until(records: Iterable[Record], now_s: float) -> float:
    """Return until when a location is not retried because it had no capacity."""
    failed = _moments(records, Outcome.FAILED, now_s)
    return failed[-1] + _HOLDS.pause_s(len(failed)) if failed else 0.0


def _is_resting(records: Sequence[Record], now_s: float) -> bool:
    """Return whether so many machines failed since the last one served that requests must pause."""
    served_s = max((each.served_unix_s or 0.0 for each in records), default=0.0)
    failed = [moment for moment in _moments(records, Outcome.FAILED, now_s) if moment > served_s]
    if len(failed) < _PATIENCE:
        return False
    return now_s < failed[-1] + _HOLDS.pause_s(len(failed) + 1)


def _moments(records: Iterable[Record], ending: Outcome, now_s: float) -> list[float]:
    """Return when machines ended in this way in the last hour."""
    moments = (each.gone_unix_s for each in records if each.ending is ending and each.gone_unix_s is not None)
    return sorted(moment for moment in moments if moment > now_s - HOUR_S)
