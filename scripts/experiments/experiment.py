"""Common parts of the experiments: command line, field, table, page, picture, and a file with every latency.

I/O. Prints, and writes ``NAME.json``, ``NAME.md`` and ``NAME.png`` into the folder of the command line. An experiment
states its options and measures::

    def measure(options: Options) -> Report: ...

    if __name__ == "__main__":
        run_experiment(command_line(__doc__), measure)
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, astuple, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import yaml
from bench_path import ROOT
from field import REPLICA, Field, Served, Work
from machine import MachineState, machine_state, require_trust, require_writable
from report import markdown_table, number_text, print_table, progress
from samples import Sample, Summary
from skeleton import Options, add_allow_load, clean_exit

from gdp.host.run_registry import RunRegistry
from lab.process import new_run

OUTPUT: Final = ROOT / "docs" / "experiments"
CASES: Final = ("one server", "two replicas")
_COLUMNS: Final = ("", "requests", "failed", "mean, ms", "p50, ms", "p99, ms", "worst, ms")
Panels = dict[str, dict[str, list[float]]]  # by panel and case
_FIGURES: Final = ("figure", "here", "target", "", "paper")
_LIST: Final = "\n\n- "  # begins the first list of a text
_PAGES: Final = Path(__file__).with_name("pages")
_WRAPPED: Final = re.compile(r"(?<!```bash)(?<=[^\n])\n(?!\n|\Z|- |#|```)\s*")
PAPERS: Final[dict[str, Any]] = yaml.safe_load((_PAGES / "papers.yaml").read_text(encoding="utf-8"))  # their figures


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

    def cells(self) -> tuple[str, ...]:
        """Return its row of a table."""
        target = "" if self.target is None else f"{'≤' if self.at_most else '≥'} {number_text(self.target)}"
        return self.what, number_text(self.measured), target, self.outcome, self.paper


@dataclass(frozen=True, slots=True)
class Rows:
    """Table of a page, which is also printed.

    ``title``: in print. ``words``: first columns, of words, in print. ``numbers``: last columns, of figures, in a page.
    ``is_marked``: a busy machine marks each row with its load.
    """

    head: Sequence[str]
    cells: Sequence[Sequence[str]]
    title: str = ""
    words: int = 1
    numbers: int = 0
    is_marked: bool = False

    def under(self, state: MachineState) -> list[Sequence[str]]:
        """Return the rows as measured on a machine."""
        mark = state.mark if self.is_marked else ""
        return [(first + mark, *more) for first, *more in self.cells]


@dataclass(frozen=True, slots=True)
class Report:
    """Outcome of an experiment.

    Args:
        name: of its files, such as ``fig5``, and of the text of its page, whose first line is the title.
        document: what the JSON has, without the machine.
        tables: by their names in the text; without any, the text itself is printed.
        draw: writes the picture to a path, under a title.
        figures: further ones in the text.
        settings: stated at the end of the page; a report with settings also prints the notes, the text's list.
    """

    name: str
    document: Mapping[str, object]
    tables: Mapping[str, Rows]
    draw: Callable[[Path, str], None]
    figures: Mapping[str, object]
    settings: Mapping[str, str | int | float] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        name: str,
        groups: Mapping[str, Sequence[Sample]],
        findings: Sequence[Finding],
        settings: Mapping[str, str | int | float],
        draw: Callable[[Path, str], None],
        figures: Mapping[str, object] | None = None,
    ) -> Report:
        """Return the report on latencies; ``groups``: samples by their label in the table."""
        rows = [
            (label, str(found.count), str(found.failed), *(number_text(1e3 * each) for each in astuple(found)[2:]))
            for label, found in ((label, Summary.of(samples)) for label, samples in groups.items())
        ]
        document = {
            "settings": dict(settings),
            "groups": {label: [_short(each) for each in samples] for label, samples in groups.items()},
            "findings": [{**asdict(each), "outcome": each.outcome} for each in findings],
        }
        tables = {
            "latencies": Rows(_COLUMNS, rows, "latency at the robot's node", is_marked=True),
            "findings": Rows(_FIGURES, [each.cells() for each in findings], "figures", is_marked=True),
        }
        return cls(name, document, tables, draw, figures or {}, settings)

    def to_dict(self, state: MachineState) -> dict[str, object]:
        """Return the document, with the machine."""
        return {"experiment": self.name, "machine": asdict(state), **self.document}

    def to_text(self, state: MachineState) -> str:
        """Return the page in Markdown, without its last line."""
        tables = {
            name: markdown_table(each.head, each.under(state), each.numbers) for name, each in self.tables.items()
        }
        return text_of(self.name, **tables, **self.figures)

    def to_page(self, state: MachineState) -> str:
        """Return the page in Markdown."""
        stated = "; ".join(f"{key}: {value}" for key, value in self.settings.items())
        last = f"Measured on {state}. Settings: {stated}." if stated else f"Written on {state}."
        return f"{self.to_text(state)}\n\n{last}\n"

    def show(self, state: MachineState) -> None:
        """Print the title, the tables and the notes."""
        text = self.to_text(state)
        print(f"{title_of(text)}\n{state}")
        for each in self.tables.values():
            print_table(each.head, each.under(state), title=each.title, words=each.words)
        if self.settings or not self.tables:
            print(f"- {text.partition(_LIST)[2]}" if self.settings else text)


def text_of(name: str, **figures: object) -> str:
    """Return a text with its figures, in which each paragraph and each item of a list is one line."""
    text = (_PAGES / f"{name}.md").read_text(encoding="utf-8").rstrip("\n")
    return _WRAPPED.sub(" ", text).format(**figures)


def title_of(text: str) -> str:
    """Return the title of a page."""
    return text.partition("\n")[0].removeprefix("# ")


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
    measure: Callable[[Options], Report],
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
        report.draw(folder / f"{report.name}.png", title_of(report.to_text(state)))
        (folder / f"{report.name}.json").write_text(_text(document) + "\n", encoding="utf-8")
        (folder / f"{report.name}.md").write_text(report.to_page(state), encoding="utf-8")
        progress(f"written: {folder / report.name}.json, .md and .png")


def _text(document: Mapping[str, object]) -> str:
    """Return JSON with a line for each key."""
    return "{\n" + ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in document.items()) + "\n}"


def _short(sample: Sample) -> list[object]:
    """Return latency and server's time in ms, the machine that answered, and whether the answer was right."""
    return [round(1e3 * sample.latency_s, 2), round(1e3 * sample.worked_s, 2), sample.machine, sample.is_right]
