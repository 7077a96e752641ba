"""Choice of offers for replicas: price, region and latency."""

from __future__ import annotations

import pytest

from fog.cluster import MachineRequest
from fog.hardware import Hardware, Offer
from fog.plan.choice import Weights, choose
from gdp.errors import LocalError


def offer(region: str, usd: float, cpus: int = 4, gpu: str = "", *, spot: bool = True) -> Offer:
    return Offer(
        "aws", region, f"type{cpus}{gpu}", Hardware(cpus, 16, gpu, 1 if gpu else 0), is_spot=spot, usd_per_hour=usd
    )


def regions(offers: list[Offer], wanted: list[MachineRequest], **more: object) -> list[str]:
    return [choice.offer.region for choice in choose(offers, wanted, **more)]  # type: ignore[arg-type]


FOUR = MachineRequest(Hardware(4), is_spot=True)
LIST = [offer("east", 0.10), offer("west", 0.12), offer("far", 0.05), offer("far", 0.04, cpus=2)]


def test_replicas_go_to_different_regions_the_cheapest_first() -> None:
    assert regions(LIST, [FOUR, FOUR, FOUR]) == ["far", "east", "west"]


def test_a_region_is_shared_only_when_all_have_one() -> None:
    assert regions(LIST, [FOUR] * 4) == ["far", "east", "west", "far"]
    assert regions(LIST, [FOUR, FOUR], weights=Weights(0, spreads=False)) == ["far", "far"]


def test_a_near_region_is_worth_its_price() -> None:
    latency = {"east": 10.0, "west": 15.0, "far": 200.0}
    assert regions(LIST, [FOUR], latency_ms=latency) == ["east"]
    assert regions(LIST, [FOUR], latency_ms=latency, weights=Weights(usd_per_hour_per_ms=0.0)) == ["far"]


def test_an_unmeasured_region_counts_as_the_slowest() -> None:
    assert regions(LIST, [FOUR], latency_ms={"east": 10.0, "west": 200.0}) == ["east"]


def test_a_region_that_is_asked_for_is_taken_and_the_others_keep_away_from_it() -> None:
    assert regions(LIST, [FOUR, MachineRequest(Hardware(4), "far", True)]) == ["east", "far"]


def test_regions_in_use_and_regions_to_avoid_come_last() -> None:
    assert regions(LIST, [FOUR], used=["far"]) == ["east"]
    assert regions(LIST, [FOUR], avoid=["far", "east"]) == ["west"]
    assert regions(LIST, [FOUR], avoid=["far", "east", "west"]) == ["far"]


def test_a_choice_says_why() -> None:
    (choice,) = choose(LIST, [FOUR], {"east": 10.0}, used=["far"], avoid=["west"])
    for word in ("3 regions", "away from far", "not west", "10 ms", "above the cheapest"):
        assert word in choice.why


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        (MachineRequest(Hardware(8), is_spot=True), "the nearest is type4 in far"),
        (MachineRequest(Hardware(4, gpu="T4", gpus=1), is_spot=True), "the nearest"),
        (MachineRequest(Hardware(4)), "nothing at all"),
        (MachineRequest(Hardware(4), "mars", True), "there is in east, far, west"),
    ],
)
def test_where_nothing_fits_the_nearest_is_named(wanted: MachineRequest, said: str) -> None:
    with pytest.raises(LocalError, match=said):
        choose(LIST, [wanted])


def test_another_gpu_is_nearer_than_none() -> None:
    with pytest.raises(LocalError, match="type4T4"):
        choose([*LIST, offer("east", 0.5, gpu="T4")], [MachineRequest(Hardware(4, gpu="A100", gpus=1), is_spot=True)])
