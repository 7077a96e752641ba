"""Regions of machines: by the option ``--region``, and misspelled ones."""

from __future__ import annotations

import pytest

from fog.cli.market import in_regions
from fog.cluster import MachineRequest
from fog.hardware import Hardware
from gdp.errors import LocalError

MACHINES = [MachineRequest(Hardware(2), region, is_spot=True) for region in ("", "east", "")]


def test_machines_take_the_stated_regions_in_turn() -> None:
    assert [each.region for each in in_regions(MACHINES, ["north", "west"])] == ["north", "west", "north"]


def test_without_the_option_the_launch_file_decides() -> None:
    assert in_regions(MACHINES, []) == tuple(MACHINES)


@pytest.mark.parametrize(
    ("region", "meant"),
    [
        ("us-wst-1", "us-west-1"),
        ("us-wst-2", "us-west-2"),
        ("eu-cental-1", "eu-central-1"),
        ("aws/us-eas-2", "us-east-2"),
    ],
)
def test_a_misspelled_region_is_refused_with_the_one_that_is_meant(region: str, meant: str) -> None:
    with pytest.raises(LocalError, match=f"no region is called {region}; did you mean {meant}\\?"):
        in_regions([*MACHINES, MachineRequest(Hardware(2), region)], [])


@pytest.mark.parametrize("region", ["west", "eu-west-3", "ap-southeast-1", "me-central-1", "gcp/us-west4", "local-e"])
def test_a_region_that_no_list_has_is_no_misspelled_one(region: str) -> None:
    assert [each.region for each in in_regions(MACHINES[:1], [region])] == [region]
