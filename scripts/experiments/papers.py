"""Experiments of both papers, and one table of their figures and ours.

    sudo .venv/bin/python scripts/experiments/papers.py              # everything: about half an hour
    sudo .venv/bin/python scripts/experiments/papers.py --only fig7  # one of them, and the table
    .venv/bin/python scripts/experiments/papers.py --collect         # only the table, from the JSON that is there

Writes ``docs/experiments/papers.md`` and ``results.json``; each experiment writes its own page, picture and JSON. An
experiment that fails is reported, the others still run, and the exit code is 1.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Final

import typer
from bench_path import ROOT
from report import progress
from results import machines_of, page_of, rows_of

__all__: list[str] = []

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

EXPERIMENTS: Final = ("offload", "table1", "fig5", "fig6", "fig7", "fig9", "outages", "availability")
_PAGES: Final = ROOT / "docs" / "experiments"
_HERE: Final = Path(__file__).parent


@app.command(epilog="Example: sudo .venv/bin/python scripts/experiments/papers.py --only fig6 --only fig7")
def main(
    only: Annotated[list[str] | None, typer.Option(help="One of the experiments; may be repeated.")] = None,
    collect: Annotated[bool, typer.Option("--collect", help="Run nothing.")] = False,
    folder: Annotated[Path, typer.Option(help="Where the JSON is, and where the table goes.")] = _PAGES,
) -> None:
    """Run the experiments of both papers, and write one table."""
    if unknown := set(only or ()) - set(EXPERIMENTS):
        raise typer.BadParameter(f"--only {', '.join(unknown)}: expected one of {', '.join(EXPERIMENTS)}")
    failed = []
    for name in () if collect else only or EXPERIMENTS:
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
    app()
