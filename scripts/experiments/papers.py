"""Experiments of both papers, one after the other; each writes its own page, picture and JSON.

    sudo .venv/bin/python scripts/experiments/papers.py                # everything: about half an hour

If an experiment fails, the others still run, and the exit code is 1. Between two experiments the command waits until
the load has settled.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from experiment import OUTPUT
from machine import data_folder, machine_state, require_trust, require_writable
from report import progress
from skeleton import add_allow_load, clean_exit

EXPERIMENTS: Final = ("offload", "table1", "fig4", "fig5", "fig6", "fig7", "fig9", "outages", "availability", "anycast")
_HERE: Final = Path(__file__).parent
_SETTLES_S: Final = 300.0  # five times the mean over which the system counts its load
_LOOK_S: Final = 5.0


def main(words: Sequence[str] | None = None, scripts: Path = _HERE) -> None:
    """Run the experiments of both papers; ``scripts`` holds ``NAME.py`` of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=OUTPUT, help="where JSON, pages and pictures go")
    add_allow_load(parser)
    options = parser.parse_args(words)
    folder: Path = options.folder
    with clean_exit():
        require_writable(folder)
        require_trust(machine_state(), allow_load=options.allow_load)
        # without them two would fail after the others have run
        data_folder("planning", [f"{each}.cfg" for each in ("Home", "cubicles", "Twistycool")])
        failed = [name for name in EXPERIMENTS if not _succeeds(scripts / f"{name}.py", options)]
    if failed:
        sys.exit(f"error: failed: {', '.join(failed)}")


def _succeeds(script: Path, options: argparse.Namespace) -> bool:
    """Run an experiment once the load of the one before has settled; return whether it succeeded."""
    progress(f"== {script.stem}")
    end_s = time.monotonic() + _SETTLES_S
    while not options.allow_load and machine_state().is_busy and time.monotonic() < end_s:
        time.sleep(_LOOK_S)
    argv = [sys.executable, str(script), "--out", str(options.folder)]
    return subprocess.run([*argv, *(["--allow-load"] if options.allow_load else [])], check=False).returncode == 0


if __name__ == "__main__":
    main()
