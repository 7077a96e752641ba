"""Common parts of the experiments: a field, a table, a page, and a file with every latency.

I/O. Prints, and writes ``figN.json`` and ``figN.md`` into the folder of the command line.

"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Final

import typer
from bench_path import ROOT
from field import ROBOT, Field, Served, Work
from machine import MachineState
from report import number_text, progress
from rich.console import Console
from rich.table import Table
from samples import Sample, Summary
from series import Series
from skeleton import clean_exit, new_run

__all__ = [
    "Asking",
    "Finding",
    "JsonOption",
    "OutOption",
    "QuickOption",
    "Report",
    "conclude",
    "field_of",
    "place_of",
]

_OUTPUT: Final = ROOT / "docs" / "experiments"
_BEGIN_S: Final = 90.0
_SILENT_S: Final = 20.0  # silence of a client between two samples
_CONSOLE_COLUMNS: Final = 150
_COLUMNS: Final = ("requests", "failed", "mean, ms", "p50, ms", "p99, ms", "worst, ms")

QuickOption = Annotated[bool, typer.Option("--quick", help="A few seconds: does it work? Writes nothing by itself.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print what would be written as JSON, and no table.")]
OutOption = Annotated[Path | None, typer.Option("--out", help="Folder for JSON, page and pictures.")]


@dataclass(frozen=True, slots=True)
class Finding:
    """Figure, with its target and the figure of the paper.

    Args:
        target: the least accepted value; None: there is no target.
        at_most: ``target`` is the most instead.
        paper: in words; empty: not known for sure.
    """

    what: str
    measured: float
    target: float | None = None
    at_most: bool = False
    paper: str = ""

    @property
    def outcome(self) -> str:
        """Return ``met``, ``MISSED`` or nothing."""
        if self.target is None:
            return ""
        return "met" if (self.measured <= self.target if self.at_most else self.measured >= self.target) else "MISSED"

    def cells(self) -> tuple[str, ...]:
        """Return its row of a table."""
        target = "" if self.target is None else f"{'≤' if self.at_most else '≥'} {number_text(self.target)}"
        return self.what, number_text(self.measured), target, self.outcome, self.paper


@dataclass(frozen=True, slots=True)
class Report:
    """Outcome of an experiment.

    Args:
        name: of its files, such as ``fig5``.
        setting: the method, in sentences for the page.
        groups: samples by their label in the table.
        notes: differences from the paper, in sentences.
    """

    name: str
    title: str
    command: str
    setting: Sequence[str]
    groups: Mapping[str, Sequence[Sample]]
    findings: Sequence[Finding]
    notes: Sequence[str]
    settings: Mapping[str, str | int | float] = field(default_factory=dict)

    def rows(self) -> list[tuple[str, ...]]:
        """Return the table's rows, name first."""
        rows = []
        for name, samples in self.groups.items():
            found = Summary.of(samples)
            times = (found.mean_s, found.p50_s, found.p99_s, found.worst_s)
            rows.append((name, str(found.count), str(found.failed), *(number_text(1e3 * each) for each in times)))
        return rows

    def to_dict(self, state: MachineState) -> dict[str, object]:
        """Return the whole report, every latency included."""
        return {
            "experiment": self.name,
            "machine": asdict(state),
            "settings": dict(self.settings),
            "groups": {name: [_short(each) for each in samples] for name, samples in self.groups.items()},
            "findings": [{**asdict(each), "outcome": each.outcome} for each in self.findings],
        }

    def to_page(self, state: MachineState, pictures: Sequence[str]) -> str:
        """Return the page in Markdown."""
        parts = [f"# {self.title}", *self.setting, f"```bash\n{self.command}\n```"]
        parts += [f"![{self.title}]({each})" for each in pictures]
        parts += [_table(("", *_COLUMNS), self.rows())]
        parts += [_table(("figure", "here", "target", "", "paper"), [each.cells() for each in self.findings])]
        parts += ["\n".join(f"- {note}" for note in self.notes)]
        reported = "; ".join(f"{key}: {value}" for key, value in self.settings.items())
        return "\n\n".join([*parts, f"Measured on {state}. {reported}."]) + "\n"


@contextmanager
def field_of(
    served: Sequence[Served], work: Mapping[str, Work], delays: Mapping[str, float] | None = None
) -> Iterator[Field]:
    """Yield a field; exit with a clear message if there can be none."""
    with clean_exit(), new_run() as run, Field(run, served, work, delays=delays) as place:
        yield place


class Asking:
    """Series in progress, read a sample at a time; a context manager that ends its client.

    Attributes:
        twice: surplus answers that reached a call; None until the end, or where they were not counted.
        heard: answers in all; the same.
    """

    def __init__(self, place: Field, series: Series) -> None:
        self._series = series
        self._client = place.client(ROBOT, "ask", **asdict(series))
        self.twice: int | None = None
        self.heard: int | None = None

    def __enter__(self) -> Asking:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.__exit__(None, None, None)

    def __iter__(self) -> Iterator[Sample]:
        """Yield each sample as it comes; raises FailedError if none comes in time."""
        self._client.read(_BEGIN_S)
        while "sample" in (said := self._client.read(max(2 * self._series.patience_s, _SILENT_S))):
            reported = said["sample"]
            if isinstance(reported, dict):
                yield Sample(**reported)
        twice, heard = said["twice"], said["heard"]
        self.twice, self.heard = (each if isinstance(each, int) else None for each in (twice, heard))

    def by_service(self, what: str) -> dict[str, list[Sample]]:
        """Return all samples of each service, and report progress at intervals."""
        found: dict[str, list[Sample]] = {}
        for number, sample in enumerate(self, 1):
            found.setdefault(sample.service, []).append(sample)
            if number % max(self._series.count // 5, 1) == 0:
                progress(f"{what}: {number} of {self._series.count}")
        return found


def place_of(out: Path | None, *, quick: bool) -> Path | None:
    """Return the output folder, or None."""
    return out or (None if quick else _OUTPUT)


def conclude(report: Report, state: MachineState, out: Path | None, pictures: Sequence[str], *, as_json: bool) -> None:
    """Print a report, and write its files into ``out`` if that is a folder; the pictures are there already."""
    items = report.to_dict(state).items()
    text = "{\n" + ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in items) + "\n}"
    if as_json:
        print(text)
    else:
        _show(report, state)
    if out is not None:
        (out / f"{report.name}.json").write_text(text + "\n", encoding="utf-8")
        (out / f"{report.name}.md").write_text(report.to_page(state, pictures), encoding="utf-8")
        progress(f"written: {out / report.name}.json, .md and .png")


def _show(report: Report, state: MachineState) -> None:
    console = Console() if sys.stdout.isatty() else Console(width=_CONSOLE_COLUMNS)
    console.print(f"[bold]{report.title}[/bold]\n{state}", highlight=False)
    latencies = Table("", *_COLUMNS, title="latency at the robot's node", title_justify="left")
    for row in report.rows():
        latencies.add_row(*row)
    findings = Table("figure", "here", "target", "", "paper", title="figures", title_justify="left")
    for finding in report.findings:
        findings.add_row(*finding.cells())
    console.print(latencies, findings)
    for note in report.notes:
        console.print(f"- {note}", markup=False, highlight=False, soft_wrap=True)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _short(sample: Sample) -> list[object]:
    """Return latency and server's time in ms, the machine that answered, and whether the answer was right."""
    return [round(1e3 * sample.latency_s, 2), round(1e3 * sample.worked_s, 2), sample.machine, sample.is_right]
