"""Golden traces: code that should not change what goes over a link does not change a byte of it."""

from __future__ import annotations

import json

import pytest

from tests.golden.traces import COUNT, TRACES, Trace, record

_USUAL = 20  # traces of the change lane; the others are marked nightly
RECORDED: dict[str, tuple[int, str]] = json.loads(TRACES.read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    "seed", [pytest.param(seed, marks=[pytest.mark.nightly] if seed >= _USUAL else []) for seed in range(COUNT)]
)
def test_every_frame_is_as_recorded(seed: int) -> None:
    """A change of bytes is made on purpose: then ``python -m tests.golden.traces --save`` renews the record."""
    assert record(seed) == Trace(*RECORDED[str(seed)])


def test_another_seed_gives_other_frames() -> None:
    assert len({digest for _, digest in RECORDED.values()}) == COUNT
