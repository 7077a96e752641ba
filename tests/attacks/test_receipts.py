"""A reader that invents receipts, so that its publisher floods the path to it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

import pytest

from gdp.client import writer_proxy
from gdp.errors import DropReason
from gdp.frame.codec import ETHER_BYTES, Kind, decode
from gdp.message.acknack import AckNack
from lab.simulation import Simulation
from lab.topology import chain
from tests.journeys.flows import advertise

RATE_BYTES_S: Final = 250e3
FIFO_S: Final = 0.1
SIZE, HZ = 40_000, 50  # eight times the rate of the path
ADAPTS_S, MEASURED_S = 2.0, 6.0
HELD_US: Final = 300_000


@pytest.mark.parametrize("reliable", [False, True], ids=["best-effort", "reliable"])
def test_b10_a_reader_that_says_to_have_all_frames_gets_no_more_than_its_path_carries(
    reliable: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says that nothing was lost, and that what came had waited at its own end, so that no queue shows."""
    world = Simulation(topology=chain(3), keepalive_ms=None)
    assert world.run_until_attached()
    robot, reader = world.members
    flow = advertise(world, "/image", robot, reliable=reliable)
    flow.read_by(reader)
    assert world.network.run(5, lambda: flow.is_read_by(1))
    link = world.cables[frozenset(("s2", "s3"))]
    link.bytes_s, link.fifo_s = RATE_BYTES_S, FIFO_S
    sent = [0, 0]  # bytes, and the frames of a message

    def count(_at_s: float, a: str, b: str, frame: bytes) -> None:
        header = decode(frame, ETHER_BYTES)
        if (a, b) == ("s1", "s2") and header.kind == Kind.DATA:
            sent[:] = sent[0] + len(frame), max(sent[1], header.parts)

    def lie(kind: type[AckNack], fields: Sequence[object]) -> AckNack:
        report = kind(*fields)  # type: ignore[arg-type]
        all_frames = report.newest * sent[1] + report.newest_part + 1
        lies = {"received": all_frames, "frames": all_frames, "held_us": HELD_US}
        report = report if report.flags else report._replace(missing=(), lost=0, **lies)  # type: ignore[arg-type]
        return report._replace(next_number=report.newest, next_part=report.newest_part) if reliable else report

    world.network.taps.append(count)
    monkeypatch.setattr(writer_proxy, "new_tuple", lie)
    for number in range(int((ADAPTS_S + MEASURED_S) * HZ)):
        world.network.call(number / HZ, partial(flow.publish, bytes(SIZE)))
    world.network.run(ADAPTS_S)
    before = sent[0]
    world.network.run(MEASURED_S)
    assert (sent[0] - before) / MEASURED_S <= 1.6 * RATE_BYTES_S
    assert flow.publisher.drops[DropReason.UNPROVEN]
