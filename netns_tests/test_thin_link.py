"""Relay of a thin link between namespaces: which frames cross it; the bench ``uplink`` reports how late it was."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[1] / "scripts" / "bench"))

from thin_link.conditions import Conditions, Direction
from thin_link.line import ADDRESSES, CLOUD, ROBOT, Used, open_line, thin_link_lab

from lab.machines import Lab
from lab.process import new_run

pytestmark = pytest.mark.netns

_FRAME, _DATAGRAM = 1_500, 1_472
_PORT = 7_001
_SILENCE_S = 1.5
_RECEIVE_BUFFER_FORCE = 33


@pytest.fixture
def lab() -> Iterator[Lab]:
    with new_run() as run:
        yield thin_link_lab(run)


def link(*, bits_s: float, fifo_frames: int, loss: float, seed: int) -> Conditions:
    """Return a link of 5 ms each way."""
    both = Direction(bits_s, 5.0, fifo_frames * _FRAME, loss, 1.0)
    return Conditions("test", both, both, seed)


def receiver() -> socket.socket:
    """Return a socket of the cloud that keeps all that comes."""
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setsockopt(socket.SOL_SOCKET, _RECEIVE_BUFFER_FORCE, 16 << 20)
    opened.bind((ADDRESSES[CLOUD], _PORT))
    opened.settimeout(_SILENCE_S)
    return opened


def crossed(lab: Lab, conditions: Conditions, count: int) -> tuple[list[int], Used]:
    """Send so many full datagrams at once; return the numbers of those that crossed, and the use of the link."""
    numbers = []
    with (
        open_line(lab, conditions) as line,
        lab.inside(CLOUD, receiver) as cloud,
        lab.inside(ROBOT, lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as robot,
    ):
        line.begin()
        for number in range(count):
            robot.sendto(number.to_bytes(4, "big") + bytes(_DATAGRAM - 4), (ADDRESSES[CLOUD], _PORT))
        with suppress(TimeoutError):
            while True:
                numbers.append(int.from_bytes(cloud.recv(_DATAGRAM)[:4], "big"))
        return numbers, line.end()


def test_a_burst_that_exceeds_the_fifo_loses_exactly_what_does_not_fit(lab: Lab) -> None:
    numbers, used = crossed(lab, link(bits_s=24_000, fifo_frames=3, loss=0.0, seed=1), 40)
    assert numbers == [0, 1, 2]  # a frame takes half a second, the burst far less
    assert (used.up.queue_drops, used.up.offered) == (37, 40)


def test_frames_cross_in_order_and_one_seed_loses_the_same_ones(lab: Lab) -> None:
    conditions = link(bits_s=50e6, fifo_frames=500, loss=0.1, seed=5)
    (once, used), (again, _) = crossed(lab, conditions, 300), crossed(lab, conditions, 300)
    assert once == again == sorted(once)
    assert len(once) < 300
    assert (used.up.losses, used.up.offered) == (300 - len(once), 300)
