"""Experiments of both papers, and one table of their figures and ours.

    sudo .venv/bin/python scripts/experiments/papers.py              # everything: about half an hour
    sudo .venv/bin/python scripts/experiments/papers.py --only fig7  # one of them, and the table
    .venv/bin/python scripts/experiments/papers.py --collect         # only the table, from the JSON that is there

Each experiment writes its own page, picture and JSON. Then ``papers.md`` and ``results.json`` are written, unless an
experiment failed: the others still run, no table is written, and the exit code is 1. Rows that were not measured in
this run name their day, commit and load. Between two experiments the command waits until the load has settled.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from experiment import OUTPUT
from machine import data_folder, machine_state, require_trust, require_writable
from report import progress
from results import machines_of, page_of, rows_of
from skeleton import add_allow_load, clean_exit

EXPERIMENTS: Final = ("offload", "table1", "fig4", "fig5", "fig6", "fig7", "fig9", "outages", "availability", "anycast")
_HERE: Final = Path(__file__).parent
_SETTLES_S: Final = 300.0  # five times the mean over which the system counts its load
_LOOK_S: Final = 5.0


def main(words: Sequence[str] | None = None, scripts: Path = _HERE) -> None:
    """Run the experiments of both papers, and write one table; ``scripts`` holds ``NAME.py`` of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", choices=EXPERIMENTS, help="this experiment; may be repeated")
    parser.add_argument("--collect", action="store_true", help="run nothing")
    parser.add_argument("--folder", type=Path, default=OUTPUT, help="where JSON, pages, pictures and the table go")
    add_allow_load(parser)
    options = parser.parse_args(words)
    folder: Path = options.folder
    names = () if options.collect else options.only or EXPERIMENTS
    with clean_exit():
        require_writable(folder)
        if names:
            require_trust(machine_state(), allow_load=options.allow_load)
        if {"offload", "fig5"}.intersection(names):  # these would fail after the others have run
            data_folder("planning", [f"{each}.cfg" for each in ("Home", "cubicles", "Twistycool")])
        failed = [name for name in names if not _succeeds(name, scripts, folder, allow_load=options.allow_load)]
    if failed:
        sys.exit(f"error: failed: {', '.join(failed)}; no table is written (--collect writes one, and marks its rows)")
    rows, missing = rows_of(folder, names)
    (folder / "papers.md").write_text(page_of(rows, machines_of(folder), missing), encoding="utf-8")
    lines = ",\n".join(json.dumps(asdict(row)) for row in rows)
    (folder / "results.json").write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    progress(f"written: {folder / 'papers.md'} and results.json, {len(rows)} rows")


def _succeeds(name: str, scripts: Path, folder: Path, *, allow_load: bool) -> bool:
    """Run an experiment once the load of the one before has settled; return whether it succeeded."""
    progress(f"== {name}")
    end_s = time.monotonic() + _SETTLES_S
    while not allow_load and machine_state().is_busy and time.monotonic() < end_s:
        time.sleep(_LOOK_S)
    argv = [sys.executable, str(scripts / f"{name}.py"), "--out", str(folder)]
    return subprocess.run([*argv, *(["--allow-load"] if allow_load else [])], check=False).returncode == 0


if __name__ == "__main__":
    main()
