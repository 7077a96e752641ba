"""Golden traces: code that should not change what goes over a link does not change a byte of it."""

from __future__ import annotations

import json

import pytest

from tests.golden.traces import COUNT, TRACES, Trace, record

# Traces of the change lane: they take 99 of 100 branches that the first twenty take. The others are marked nightly.
_USUAL = (0, 1, 3, 5, 6, 11, 19)
RECORDED: dict[str, tuple[int, str]] = json.loads(TRACES.read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    "seed", [pytest.param(seed, marks=[] if seed in _USUAL else [pytest.mark.nightly]) for seed in range(COUNT)]
)
def test_every_frame_is_as_recorded(seed: int) -> None:
    """A change of bytes is made on purpose: then ``python -m tests.golden.traces --save`` renews the record."""
    assert record(seed) == Trace(*RECORDED[str(seed)])


def test_another_seed_gives_other_frames() -> None:
    assert len({digest for _, digest in RECORDED.values()}) == COUNT
