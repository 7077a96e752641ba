"""A seed repeats a whole run: names, times and lengths of all frames, in another process with other hashes."""

from __future__ import annotations

import os
import subprocess
import sys

RUN = """
import hashlib
from gdp.frame.codec import ETHER_BYTES, decode
from tests.journeys.test_parity import camera

def run(seed):
    made = camera(reliable=True, seed=seed, readers=2)
    made.cable.loss = 0.03
    seen = hashlib.sha256()

    def tap(at_s, a, b, frame):
        header = decode(frame, ETHER_BYTES)
        row = at_s, a, b, header.kind, header.destination, header.number, header.part, len(frame)
        seen.update(repr(row).encode())

    made.flow.world.network.taps.append(tap)
    made.stream(10, 0.1, 40_000)
    assert made.flow.publisher.protection.repairs
    return seen.hexdigest()

print(*map(run, {seeds}))
"""


def test_a_seed_repeats_every_frame_and_another_one_does_not() -> None:
    runs = [
        subprocess.Popen(
            [sys.executable, "-c", RUN.format(seeds=seeds)],
            env={**os.environ, "PYTHONHASHSEED": hashes},
            stdout=subprocess.PIPE,
            text=True,
        )
        for seeds, hashes in (([1, 2], "1"), ([1], "2"))
    ]
    said = [run.communicate(timeout=120)[0] for run in runs]
    assert [run.returncode for run in runs] == [0, 0]
    (one, two), (again,) = map(str.split, said)
    assert one == again != two
