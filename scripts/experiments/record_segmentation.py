"""Recording of segmentations, for servers that wait: runs DBNet and writes down the processor time of each run.

I/O: writes one JSON file, with the machine. Processor time is that of the one thread which runs the network, so
waiting for a core does not count. What other work costs by its use of the caches does count.

    .venv/bin/python scripts/experiments/record_segmentation.py       # about 1 minute of one core
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

import bench_path  # noqa: F401 - finds ``machine``
from machine import machine_state
from recorded import SEGMENTATION
from skeleton import clean_exit
from vision import Networks, Scene, require_networks


def main() -> None:
    """Record the times of segmentations."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=600, help="each of another frame (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=SEGMENTATION, help="the file to write")
    options = parser.parse_args()
    with clean_exit():
        require_networks("the recording in the repository")
    state, networks, seconds = machine_state(), Networks(), []
    networks.segment(Scene.draw(0).frame)  # the first run also allocates
    for seed in range(options.runs):
        scene = Scene.draw(seed)
        begun_s = time.thread_time()
        mask = networks.segment(scene.frame)
        seconds.append(round(time.thread_time() - begun_s, 5))
        if not scene.is_covered(mask):
            sys.exit(f"error: scene {seed}: the mask does not cover its words, so this run counts for nothing")
    text = json.dumps({"machine": asdict(state), "seconds": seconds})
    options.out.write_text(text.replace('"seconds"', '\n"seconds"') + "\n", encoding="utf-8")
    print(f"written: {options.out}, {len(seconds)} runs")


if __name__ == "__main__":
    main()
