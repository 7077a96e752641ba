"""Regions of machines by the option ``--region``."""

from __future__ import annotations

from fog.cli.market import in_regions
from fog.cluster import MachineRequest
from fog.hardware import Hardware

MACHINES = [MachineRequest(Hardware(2), region, is_spot=True) for region in ("", "east", "")]


def test_machines_take_the_stated_regions_in_turn() -> None:
    assert [each.region for each in in_regions(MACHINES, ["north", "west"])] == ["north", "west", "north"]


def test_without_the_option_the_launch_file_decides() -> None:
    assert in_regions(MACHINES, []) == tuple(MACHINES)
