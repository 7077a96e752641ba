"""Common parts of the experiments: command line, field, table, page, picture, and a file with every latency.

I/O. Prints, and writes ``NAME.json``, ``NAME.md`` and ``NAME.png`` into the folder of the command line. An experiment
states its options and measures; one whose samples are no latencies returns a ``Computed``::

    def measure(options: Options) -> Report: ...

    if __name__ == "__main__":
        run_experiment(command_line(__doc__), measure)
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Final

from bench_path import ROOT
from field import REPLICA, Field, Served, Work
from machine import MachineState, machine_state, require_trust, require_writable
from page_text import text_of
from report import markdown_table, number_text, print_table, progress
from samples import Sample, Summary
from skeleton import Options, add_allow_load, clean_exit

from gdp.host.run_registry import RunRegistry
from lab.process import new_run

OUTPUT: Final = ROOT / "docs" / "experiments"
CASES: Final = ("one server", "two replicas")
_COLUMNS: Final = ("requests", "failed", "mean, ms", "p50, ms", "p99, ms", "worst, ms")
Panels = dict[str, dict[str, list[float]]]  # by panel and case
_FIGURES: Final = ("figure", "here", "target", "", "paper")


@dataclass(frozen=True, slots=True)
class Finding:
    """Figure, with its target and the figure of the paper.

    ``target``: the least accepted value; None: there is no target. ``at_most``: ``target`` is the most instead.
    ``paper``: in words; empty: not known for sure.
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

    def cells(self, state: MachineState) -> tuple[str, ...]:
        """Return its row of a table; the machine's load marks it where it is high."""
        target = "" if self.target is None else f"{'≤' if self.at_most else '≥'} {number_text(self.target)}"
        return self.what + state.mark, number_text(self.measured), target, self.outcome, self.paper


@dataclass(frozen=True, slots=True)
class Report:
    """Outcome of an experiment.

    Args:
        name: of its files, such as ``fig5``.
        groups: samples by their label in the table.
        draw: writes the picture to a path, under a title.
        figures: in the text of the page, which has a title, the method, and as a list the differences from the paper.
    """

    name: str
    groups: Mapping[str, Sequence[Sample]]
    findings: Sequence[Finding]
    settings: Mapping[str, str | int | float]
    draw: Callable[[Path, str], None]
    figures: Mapping[str, object] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Return the title of the page."""
        return self._parts()[0]

    def rows(self, state: MachineState) -> list[tuple[str, ...]]:
        """Return the table's rows, name first; the machine's load marks each where it is high."""
        rows = []
        for name, samples in self.groups.items():
            found = Summary.of(samples)
            times = [number_text(1e3 * each) for each in (found.mean_s, found.p50_s, found.p99_s, found.worst_s)]
            rows.append((name + state.mark, str(found.count), str(found.failed), *times))
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

    def to_page(self, state: MachineState) -> str:
        """Return the page in Markdown."""
        command = f"```bash\nsudo .venv/bin/python scripts/experiments/{self.name}.py\n```"
        title, method, notes = self._parts()
        parts = [f"# {title}", method, command, f"![{title}]({self.name}.png)"]
        parts += [markdown_table(("", *_COLUMNS), self.rows(state))]
        parts += [markdown_table(_FIGURES, [each.cells(state) for each in self.findings])]
        stated = "; ".join(f"{key}: {value}" for key, value in self.settings.items())
        return "\n\n".join([*parts, notes, f"Measured on {state}. Settings: {stated}."]) + "\n"

    def show(self, state: MachineState) -> None:
        """Print the tables and the notes."""
        title, _, notes = self._parts()
        print(f"{title}\n{state}")
        print_table(("", *_COLUMNS), self.rows(state), title="latency at the robot's node")
        print_table(_FIGURES, [each.cells(state) for each in self.findings], title="figures")
        print(notes)

    def _parts(self) -> tuple[str, str, str]:
        """Return the title, the method and the list of differences."""
        title, _, text = text_of(self.name, **self.figures).partition("\n\n")
        method, _, notes = text.partition("\n\n- ")
        return title.removeprefix("# "), method, f"- {notes}"


@dataclass(frozen=True, slots=True)
class Computed:
    """Outcome of an experiment that writes a document and a page of its own kind.

    ``name``: of its files, such as ``table1``. ``print_tables``: without a machine, which the page names in its last
    line. ``draw``: as in ``Report``.
    """

    name: str
    document: Mapping[str, object]
    page: str
    print_tables: Callable[[], None]
    draw: Callable[[Path, str], None]

    @property
    def title(self) -> str:
        """Return the title of the page."""
        return self.page.partition("\n")[0].removeprefix("# ")

    def to_dict(self, state: MachineState) -> dict[str, object]:
        """Return the document, with the machine."""
        return {"experiment": self.name, "machine": asdict(state), **self.document}

    def to_page(self, state: MachineState) -> str:
        """Return the page in Markdown."""
        return f"{self.page}\nWritten on {state}.\n"

    def show(self, state: MachineState) -> None:
        """Print the tables."""
        print(f"{self.title}\n{state}")
        self.print_tables()


@contextmanager
def field_of(
    served: Sequence[Served], work: Mapping[str, Work], delays: Mapping[str, float] | None = None
) -> Iterator[Field]:
    """Yield a field in a run of its own."""
    with new_run() as run, Field(run, served, work, delays=delays) as place:
        yield place


def work_of(
    served: Iterable[Served], role: str, settings: Mapping[str, Mapping[str, object]], program: Path = REPLICA
) -> dict[str, Work]:
    """Return the work of each machine: the role of the program, its services, and its settings."""
    offers = list(served)
    names = {each: " ".join(one.name for one in offers if each in one.machines) for each in settings}
    return {each: Work(role, {**own, "services": names[each]}, program) for each, own in settings.items()}


def gains(
    label: str,
    one: Sequence[Sample],
    two: Sequence[Sample],
    paper: Sequence[str] = ("", ""),
    targets: Sequence[float | None] = (None, None),
) -> tuple[Finding, Finding]:
    """Return mean and p99 of one server over those of two replicas; ``label`` has ``{}`` in place of either word."""
    single, pair = Summary.of(one), Summary.of(two)
    return (
        Finding(label.format("mean"), single.mean_s / pair.mean_s, targets[0], paper=paper[0]),
        Finding(label.format("p99"), single.p99_s / pair.p99_s, targets[1], paper=paper[1]),
    )


def latencies_of(groups: Mapping[str, Sequence[Sample]], label: str, names: Iterable[str], scale: float) -> Panels:
    """Return the latencies of both cases for each panel.

    ``label``: a group's name, with ``{name}`` and ``{case}`` in it. ``scale``: 1: seconds; 1,000: milliseconds.
    """
    return {
        name: {case: [scale * each.latency_s for each in groups[label.format(name=name, case=case)]] for case in CASES}
        for name in names
    }


def command_line(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options that experiments share."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few seconds: does it work? writes nothing by itself")
    parser.add_argument("--json", action="store_true", help="print what would be written as JSON, and no table")
    parser.add_argument("--out", type=Path, help="folder for JSON, page and picture (default: docs/experiments)")
    add_allow_load(parser)
    return parser


def run_experiment(
    parser: argparse.ArgumentParser,
    measure: Callable[[Options], Report | Computed],
    words: Sequence[str] | None = None,
    *,
    is_timed: bool = True,
) -> None:
    """Run an experiment to its tables, page, picture and JSON.

    ``words``: as ``sys.argv[1:]``. ``is_timed``: other work of the machine changes the figures.
    """
    options, state = parser.parse_args(words), replace(machine_state(), is_timed=is_timed)
    folder: Path | None = options.out or (None if options.quick else OUTPUT)
    with clean_exit():
        if folder is not None:
            require_writable(folder)
        if not options.quick:
            require_trust(state, allow_load=options.allow_load)
        RunRegistry().sweep()  # remains of a killed run
        report = measure(options)
    document = report.to_dict(state)
    if options.json:
        print(_text(document))
    else:
        report.show(state)
    if folder is not None:
        report.draw(folder / f"{report.name}.png", report.title)
        (folder / f"{report.name}.json").write_text(_text(document) + "\n", encoding="utf-8")
        (folder / f"{report.name}.md").write_text(report.to_page(state), encoding="utf-8")
        progress(f"written: {folder / report.name}.json, .md and .png")


def _text(document: Mapping[str, object]) -> str:
    """Return JSON with a line for each key."""
    return "{\n" + ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in document.items()) + "\n}"


def _short(sample: Sample) -> list[object]:
    """Return latency and server's time in ms, the machine that answered, and whether the answer was right."""
    return [round(1e3 * sample.latency_s, 2), round(1e3 * sample.worked_s, 2), sample.machine, sample.is_right]
