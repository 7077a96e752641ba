"""Three robots with equal names of frames roam on lossy links for ten minutes: their one tree at a station is exact.

Each transform carries the number of its robot and its own number, so that a wrong, lost or doubled one is counted.
"""

from __future__ import annotations

import random
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Final

import pytest

from proxy.endpoints.core.qos import default
from tests.draws import TIMES
from tests.lanes import nightly
from tests.proxy.bridge.known import TRANSFORMS
from tests.proxy.bridge.sites import Ear, Sites
from tests.proxy.bridge.test_frames import ROBOTS, STATIC, fleet, pairs_of, placed, station, transforms
from tests.proxy.endpoints.fake import Publication

SWITCHES: Final = ("nuc1", "nuc3", "nuc5")
MOVING: Final = ("map>odom", "odom>base_link")
HZ: Final = 10
STAY_S: Final = (3.0, 15.0)  # at one switch
LATE_S: Final = 20.0  # between two readers that come late
LOSS_MAX: Final = 0.03
CALM_S: Final = 10.0  # afterwards, in which none roams: the last transforms arrive
ALL_STATIC: Final = Counter(f"{robot}/{pair.replace('>', f'>{robot}/')}" for robot in ROBOTS for pair in STATIC)

Placed = tuple[str, float, float]


def expected(count: int) -> Counter[Placed]:
    """Return each transform that the station is to get, with its place: its number, and its robot's."""
    return Counter(
        (
            pair.replace(">", f">{robot}/") if pair.startswith("map") else f"{robot}/{pair.replace('>', f'>{robot}/')}",
            x,
            y,
        )
        for y, robot in enumerate(ROBOTS)
        for pair in MOVING
        for x in range(count)
    )


def misses(got: Counter[Placed], wanted: Counter[Placed]) -> dict[str, int]:
    """Return how many transforms are wrong, lost and doubled."""
    return {
        "wrong": sum(count for each, count in got.items() if each not in wanted),
        "lost": sum(each not in got for each in wanted),
        "doubled": sum(count - 1 for each, count in got.items() if each in wanted),
    }


def send(publication: Publication, robot: int, number: int) -> None:
    publication.publish(transforms(*MOVING, at=(number, robot)))


def shake(sites: Sites, rng: random.Random, duration_s: float) -> int:
    """Draw the losses of the links, and when each robot roams where; return how often robots roam."""
    count = 0
    for cable in sites.world.cables.values():
        cable.loss, cable.burst_frames = rng.uniform(0, LOSS_MAX), rng.choice((1.0, 4.0))
    for robot in ROBOTS:
        at_s, switch = rng.uniform(*STAY_S), "nuc1"
        while at_s < duration_s:
            switch = rng.choice([each for each in SWITCHES if each != switch])
            sites.world.network.call(at_s, partial(sites.world.roam, f"nuc1/{robot}", switch))
            at_s, count = at_s + rng.uniform(*STAY_S), count + 1
    return count


@pytest.mark.parametrize("seed", range(1, 1 + TIMES))
@pytest.mark.parametrize("duration_s", [30, *nightly(600)])
def test_of_roaming_robots_no_frame_is_wrong_lost_or_doubled(tmp_path: Path, seed: int, duration_s: int) -> None:
    sites = Sites(tmp_path, seed, look_s=0.02)
    moving, server = fleet(sites), station(sites)
    ear, count, readers = Ear(server.graph, "/tf", TRANSFORMS), duration_s * HZ, list[Ear]()

    def come(number: int) -> None:
        qos = default(latched=True, depth=100)
        readers.append(Ear(server.graph, "/tf_static", TRANSFORMS, qos=qos, node=f"/reader{number}"))

    come(0)
    robots = [machine for machine in sites.machines if machine is not server]
    assert sites.run(10, lambda: all(len(list(each.member.publications)) == 2 for each in robots))
    assert sites.run(10, lambda: all(each.is_read() for each in robots))
    for at, robot in enumerate(ROBOTS):
        sites.every(1 / HZ, count, partial(send, moving[robot], at))
    for late in range(1, int(duration_s // LATE_S) + 1):
        sites.world.network.call(late * LATE_S, partial(come, late))
    assert shake(sites, random.Random(seed), duration_s) > duration_s // 10
    sites.run(duration_s + CALM_S)
    assert misses(Counter(placed(ear)), expected(count)) == {"wrong": 0, "lost": 0, "doubled": 0}
    for robot in ROBOTS:
        numbers = [x for pair, x, _ in placed(ear) if pair == f"map>{robot}/odom"]
        assert numbers == sorted(numbers)
    assert [Counter(pairs_of(each)) for each in readers] == [ALL_STATIC] * (1 + int(duration_s // LATE_S))
    assert server.faults == {}
