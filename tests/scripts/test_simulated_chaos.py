"""Chaos in virtual time: no flow starves over thin links that are full, none is silent for long over others.

Each loss is reported.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pytest
from faults.plan import random_network
from faults.schedule import make_schedule

from gdp.client.send_options import SendOptions
from lab.faults import Fault
from tests.draws import IS_LONG, TIMES
from tests.insiders.oracle import signing_oracle
from tests.scripts.simulated_chaos import SIMULATED, SimulatedChaos

FIRST, COUNT = 1, TIMES
SWITCHES, RATE, SECONDS = (12, 0.25, 40.0) if IS_LONG else (8, 0.4, 9.0)
THIN_BITS_S, FIFO_S, IMAGE_SHARE = 4e6, 0.2, 2.0  # images offer so much of a link
LIMIT_S, WELL_S = 8.0, 2.0
SILENCE_S: Final = 1.0  # of which the slowest flow's period is 0.4, and three keepalives 0.21


@pytest.mark.parametrize("seed", range(FIRST, FIRST + COUNT))
def test_flows_over_thin_full_links_outlive_overlapping_faults(seed: int, tmp_path: Path) -> None:
    plan = random_network(seed, SWITCHES, rate=RATE, image_bits_s=IMAGE_SHARE * THIN_BITS_S)
    faults = make_schedule(plan, seed, SECONDS, kinds=SIMULATED)
    with signing_oracle():
        chaos = SimulatedChaos(plan, faults, seed)
        chaos.settle(thin_bits_s=THIN_BITS_S, fifo_s=FIFO_S)
        outlive(chaos, faults, LIMIT_S, WELL_S, tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [2, 15])
def test_images_at_the_pace_of_each_reader_starve_no_flow_over_full_links(seed: int, tmp_path: Path) -> None:
    plan = random_network(seed, 8, rate=0.4, image_bits_s=IMAGE_SHARE * THIN_BITS_S)
    faults = make_schedule(plan, seed, 12.0, kinds=SIMULATED)
    with signing_oracle():
        chaos = SimulatedChaos(plan, faults, seed, options=SendOptions(own_pace=True))
        chaos.settle(thin_bits_s=THIN_BITS_S, fifo_s=FIFO_S)
        outlive(chaos, faults, LIMIT_S, WELL_S, tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(200, 200 + 4 * COUNT))
def test_overlapping_faults_silence_no_flow_for_much_longer_than_it_takes_to_notice_them(
    seed: int, tmp_path: Path
) -> None:
    plan = random_network(seed, 13, rate=0.25)
    faults = make_schedule(plan, seed, 45.0, kinds=SIMULATED)
    with signing_oracle():
        chaos = SimulatedChaos(plan, faults, seed, keepalive_ms=None)
        chaos.settle()
        outlive(chaos, faults, SILENCE_S, 1.0, tmp_path)


def outlive(chaos: SimulatedChaos, faults: list[Fault], limit_s: float, well_s: float, journals: Path) -> None:
    """Run the faults, and expect no broken promise; of those there are, keep the nodes' journals."""
    chaos.run()
    broken = chaos.broken_promises(limit_s, well_s)
    if broken:
        chaos.world.save_journals(journals)
    assert broken == [], "\n".join([*map(str, faults), f"journals of its nodes: {journals}"])
