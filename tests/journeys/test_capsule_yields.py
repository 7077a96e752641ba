"""Uploads yield: what a robot sends live does not wait for the history that an outage has left."""

from __future__ import annotations

import statistics
from functools import partial
from pathlib import Path

import pytest

from tests.journeys.capsules import Holder, Keeping
from tests.journeys.flows import ROBOT, SERVER, advertise, row

UPLINK_BYTES_S = 1_250_000
IMAGE_BYTES = 40_000
ALONE_S = 0.043  # an image at this rate, as a loop of 5 ms sees it
FRAME_S = 1_500 / UPLINK_BYTES_S


@pytest.mark.parametrize("backlog", [False, True])
def test_a_live_image_is_as_fresh_as_alone_while_an_upload_takes_what_it_leaves(tmp_path: Path, backlog: bool) -> None:
    world = row()
    world.add_member("nuc2/store", "nuc2")
    assert world.run_until_attached()
    keeping = Keeping(advertise(world), tmp_path / "robot", 1 << 28)
    keeping.step_s = 0.005
    holder = Holder(world, tmp_path / "holder", "nuc2/store")
    camera = advertise(world, "/camera", reliable=False)
    camera.read_by(SERVER)
    assert world.network.run(5, lambda: camera.is_read_by(1))
    world.leads[ROBOT].bytes_s, world.leads[ROBOT].fifo_s = UPLINK_BYTES_S, 0.5
    if backlog:
        for _ in range(120):
            keeping.flow.publish(bytes(IMAGE_BYTES))
    sent_s, ages_s = dict[bytes, float](), list[float]()

    def shoot(number: int) -> None:
        sent_s[b"%4d" % number] = world.network.now.mono_s
        camera.publish(b"%4d" % number + bytes(IMAGE_BYTES))

    def arrived() -> bool:
        now_s = world.network.now.mono_s
        found = [each for each in world.members[SERVER].poll_messages() if each.topic == camera.topic.name]
        ages_s.extend(now_s - sent_s[each.delivered.message[:4]] for each in found)
        return False

    for number in range(30):
        world.network.call(1.0 + number / 10, partial(shoot, number))
    keeping.run(3.9, holder, until=arrived)
    assert len(ages_s) >= 28
    confirmed = keeping.kept.uploader.confirmed
    assert (keeping.kept.ring.end - confirmed > 1_000_000) is backlog
    assert confirmed > (1_500_000 if backlog else 0)
    assert statistics.median(ages_s) < 1.1 * ALONE_S + FRAME_S
    keeping.run(5, holder)
    assert keeping.run(20, holder, until=keeping.is_uploaded)
