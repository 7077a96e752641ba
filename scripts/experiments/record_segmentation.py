"""Recording of segmentations, for servers that wait: runs DBNet, and writes down the processor time of each run.

I/O: writes ``segmentation_runs.json``. Waiting for a core does not count; what other work costs in the caches does.

    .venv/bin/python scripts/experiments/record_segmentation.py     # about 1 minute of one core
"""

from __future__ import annotations

import json
import sys
import time

from recorded import SEGMENTATION
from vision import Networks, Scene

RUNS = 600


def main() -> None:
    """Record the times."""
    networks, seconds = Networks(), []
    for number in range(-1, RUNS):  # the first run also allocates, and is left out
        scene = Scene.draw(abs(number))
        begun_s = time.process_time()
        mask = networks.segment(scene.frame)
        seconds.append(round(time.process_time() - begun_s, 5))
        if not scene.is_covered(mask):
            sys.exit(f"error: frame {number}: the mask does not cover its words; nothing is written")
    SEGMENTATION.write_text(json.dumps(seconds[1:]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
