"""Erasure bench: processor time of the parity of an image at its publisher, and of its restoration at a reader.

    .venv/bin/python scripts/bench/erasure.py [--rounds 5] [--count 10] [--json FILE]

One thread, no network, no root. ``encode`` is the code over shards of 1,382 bytes, ``restore`` what a reader computes
when as many frames of each block are lost as it has parity. The counts of parity are those that a publisher chooses at
the stated loss. The shares of images in time stand in ``docs/explanation/loss.md``; ``tests/journeys/test_parity.py``
repeats them in virtual time.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from functools import partial
from typing import Final

from report import Rounds, progress
from skeleton import Options, Outcome, command_line, run_bench

from gdp.client.parity_sender import parity_for
from gdp.host.run_registry import RunRegistry
from gdp.message import erasure
from gdp.message.parity import blocks_of, span_of

IMAGES: Final = {"JPEG of 40,000 bytes": 30, "image of 921,600 bytes": 680}  # frames of 1,500 bytes
LOSSES: Final = (0.01, 0.05)
SHARD_BYTES: Final = 1_382
ENCODE_MS, RESTORE_MS, PARITY = "encode, ms", "restore, ms", "parity frames"
CODE: Final = "Cauchy, GF(256)"


def _least_ms(work: Callable[[], object], count: int) -> float:
    """Return the least processor time of ``count`` runs in milliseconds: others on the same core only add to it."""
    times = []
    for _ in range(count):
        begun_s = time.thread_time()
        work()
        times.append(time.thread_time() - begun_s)
    return 1e3 * min(times)


def _encode(blocks: list[list[bytes]], count: int) -> list[list[bytes]]:
    return [erasure.encode(shards, count) for shards in blocks]


def _restore(blocks: list[list[bytes]], parity: list[list[bytes]]) -> None:
    for shards, of_block in zip(blocks, parity, strict=True):
        here = dict(enumerate(shards[len(of_block) :], len(of_block)))
        restored = erasure.decode(here, dict(enumerate(of_block)), len(shards))
        if restored != dict(enumerate(shards[: len(of_block)])):
            raise RuntimeError("the frames are not those that were lost")


def measure(options: Options, runs: RunRegistry) -> Outcome:
    """Measure each image at each loss, round by round."""
    del runs
    over = Rounds()
    for number in range(options.rounds):
        progress(f"round {number + 1}/{options.rounds}")
        for image, parts in IMAGES.items():
            sizes = [block.size for block in blocks_of(span_of(0, parts))]
            blocks = [[os.urandom(SHARD_BYTES) for _ in range(size)] for size in sizes]
            for loss in LOSSES:
                case = f"{image}, loss {loss:.0%}"
                count = parity_for(sizes[0], loss, 0.01 / len(sizes))
                parity = _encode(blocks, count)
                over.add(CODE, case, PARITY, count * len(blocks))
                over.add(CODE, case, ENCODE_MS, _least_ms(partial(_encode, blocks, count), options.count))
                over.add(CODE, case, RESTORE_MS, _least_ms(partial(_restore, blocks, parity), options.count))
    settings = {"rounds": options.rounds, "count": options.count}
    return Outcome("erasure", "Parity of images", over, [], settings, is_whole=False)


if __name__ == "__main__":
    parser = command_line(__doc__, rounds=5, has_record=True)
    parser.add_argument("--count", type=int, default=10, help="runs of a trial")
    run_bench(parser, measure)
