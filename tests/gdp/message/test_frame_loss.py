"""Loss of frames, from what was sent and what each reader counted."""

from __future__ import annotations

from random import Random

import pytest

from gdp.frame.codec import Header, Kind, encode
from gdp.message.acknack import FRAMES_MASK
from gdp.message.frame_loss import FrameLoss

READER, OTHER = b"r" * 32, b"o" * 32
BOTH = {READER, OTHER}


def frames(*numbers: int) -> list[bytes]:
    return [encode(Header(Kind.DATA, 0, 8, 1, 0, number, 0, 1, 1, READER, READER)) for number in numbers]


def measured(
    loss: float, *, count: int = 5_000, received: int = 0, sends: int = 1, reader: bytes = READER
) -> FrameLoss:
    """Return the estimate after messages of one frame, each sent ``sends`` times, with a report every 50."""
    rng, made = Random(1), FrameLoss()
    for number in range(1, count + 1):
        made.handle_sent(frames(number) * sends)
        received += sum(rng.random() >= loss for _ in range(sends))
        if number % 50 == 0:
            made.handle_report(READER, number + 1, 0, received & FRAMES_MASK)
    return made


@pytest.mark.parametrize("sends", [1, 3])
@pytest.mark.parametrize("loss", [0.0, 0.01, 0.05, 0.3])
def test_the_estimate_is_what_the_path_loses_also_while_copies_hide_it(loss: float, sends: int) -> None:
    assert measured(loss, sends=sends).loss(BOTH, 0.0) == pytest.approx(loss, abs=0.02 if loss else 0.0)


def test_nothing_is_known_before_enough_frames_were_reported() -> None:
    assert measured(0.0, count=100).loss(BOTH, 0.0) is None
    assert measured(0.0, count=200).loss(BOTH, 0.0) == 0.0


def test_a_count_that_wraps_is_followed() -> None:
    assert measured(0.0, received=FRAMES_MASK - 500).loss(BOTH, 0.0) == 0.0


def test_a_count_that_begins_again_is_no_loss() -> None:
    made = measured(0.0)
    made.handle_sent(frames(*range(5_001, 5_101)))
    made.handle_report(READER, 5_101, 0, 3)
    made.handle_sent(frames(*range(5_101, 5_301)))
    made.handle_report(READER, 5_301, 0, 203)
    assert made.loss(BOTH, 0.0) == 0.0


def test_the_reader_with_the_highest_loss_decides_while_it_is_a_reader() -> None:
    made = measured(0.0)
    for number, received in ((1, 0), (5_001, 2_500)):
        made.handle_report(OTHER, number + 1, 0, received)
    assert made.loss(BOTH, 0.0) == pytest.approx(0.5, abs=0.01)
    made.handle_report(READER, 5_001, 0, 5_000)
    made.forget(OTHER)
    assert made.loss(BOTH, 1.0) == 0.0


def test_a_count_above_what_was_sent_is_no_loss() -> None:
    made = measured(0.0)
    made.handle_sent(frames(*range(5_001, 5_501)))
    made.handle_report(READER, 5_501, 0, 9_000)
    assert made.loss(BOTH, 0.0) == 0.0
