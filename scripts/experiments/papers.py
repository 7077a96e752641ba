"""Experiments of both papers, and one table of their figures and ours.

    sudo .venv/bin/python scripts/experiments/papers.py              # everything: about half an hour
    sudo .venv/bin/python scripts/experiments/papers.py --only fig7  # one of them, and the table
    .venv/bin/python scripts/experiments/papers.py --collect         # only the table, from the JSON that is there

Writes ``docs/experiments/papers.md`` and ``results.json``; each experiment writes its own page, picture and JSON. An
experiment that fails is reported, the others still run, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Final

from experiment import OUTPUT
from report import progress
from results import machines_of, page_of, rows_of

EXPERIMENTS: Final = ("offload", "table1", "fig5", "fig6", "fig7", "fig9", "outages", "availability")
_HERE: Final = Path(__file__).parent


def main() -> None:
    """Run the experiments of both papers, and write one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", choices=EXPERIMENTS, help="this experiment; may be repeated")
    parser.add_argument("--collect", action="store_true", help="run nothing")
    parser.add_argument("--folder", type=Path, default=OUTPUT, help="where the JSON is, and where the table goes")
    options = parser.parse_args()
    folder: Path = options.folder
    failed = []
    for name in () if options.collect else options.only or EXPERIMENTS:
        progress(f"== {name}")
        if subprocess.run([sys.executable, str(_HERE / f"{name}.py")], check=False).returncode:
            failed.append(name)
    rows = rows_of(folder)
    (folder / "papers.md").write_text(page_of(rows, machines_of(folder)), encoding="utf-8")
    lines = ",\n".join(json.dumps(asdict(row)) for row in rows)
    (folder / "results.json").write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    progress(f"written: {folder / 'papers.md'} and results.json, {len(rows)} rows")
    if failed:
        sys.exit(f"error: failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
