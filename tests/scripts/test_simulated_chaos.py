"""Chaos in virtual time, over thin links that images keep full: no flow starves, and each loss is reported."""

from __future__ import annotations

from pathlib import Path

import pytest
from faults.plan import random_network
from faults.schedule import make_schedule

from tests.draws import IS_LONG, TIMES
from tests.insiders.oracle import signing_oracle
from tests.scripts.simulated_chaos import SIMULATED, SimulatedChaos

FIRST, COUNT = 1, TIMES
SWITCHES, RATE, SECONDS = (12, 0.25, 40.0) if IS_LONG else (8, 0.4, 12.0)
THIN_BITS_S, FIFO_S, IMAGE_SHARE = 4e6, 0.2, 2.0  # images offer so much of a link
LIMIT_S, WELL_S = 8.0, 2.0


@pytest.mark.parametrize("seed", range(FIRST, FIRST + COUNT))
def test_flows_over_thin_full_links_outlive_overlapping_faults(seed: int, tmp_path: Path) -> None:
    plan = random_network(seed, SWITCHES, rate=RATE, image_bits_s=IMAGE_SHARE * THIN_BITS_S)
    faults = make_schedule(plan, seed, SECONDS, kinds=SIMULATED)
    with signing_oracle():
        chaos = SimulatedChaos(plan, faults, seed)
        chaos.settle(thin_bits_s=THIN_BITS_S, fifo_s=FIFO_S)
        chaos.run()
        broken = chaos.broken_promises(LIMIT_S, WELL_S)
        if broken:
            chaos.world.save_journals(tmp_path)
    assert broken == [], "\n".join([*map(str, faults), f"journals of its nodes: {tmp_path}"])
