"""Many trials of the insiders, over processes, and their results."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Final

from gdp.control.boundary import ErrorBoundary
from tests.insiders.trial import BrokenError, Figures, Plan, Trial, prepared

__all__ = ["Found", "Search", "plan_of", "run_plan", "searched"]

WORDS: Final = 10_000  # of one trial
_ACTS: Final = 6
_PLACE_FRAMES: Final = 1


@dataclass(frozen=True, slots=True)
class Found:
    """Trial that broke.

    Args:
        place: kind and origin of the error, or the broken invariant.
        at: the utterance, its sender and its addressee.
    """

    plan: Plan
    place: str
    text: str
    at: str
    is_exception: bool


@dataclass(slots=True)
class Search:
    """Results of many trials.

    Attributes:
        found: the first of each place.
        exceptions, broken: trials that ended by an error of ours, and by an invariant.
    """

    figures: Figures = field(default_factory=Figures)
    found: dict[str, Found] = field(default_factory=dict)
    trials: int = 0
    exceptions: int = 0
    broken: int = 0
    seconds: float = 0.0

    @property
    def statements(self) -> int:
        """Return the number of tried utterances."""
        return sum(self.figures.count.values())

    def add(self, figures: Figures, found: Found | None) -> None:
        """Add the results of one trial."""
        self.trials += 1
        self.figures.add(figures)
        if found is not None:
            self.exceptions += found.is_exception
            self.broken += not found.is_exception
            self.found.setdefault(found.place, found)


def plan_of(seed: int, words: int = WORDS) -> Plan:
    """Return the plan of a seed: every second one is stormy."""
    first = seed * 1_000_000
    return Plan(seed, tuple(range(first, first + _ACTS)), tuple(range(first, first + words)), seed % 2 == 1)


def run_plan(plan: Plan) -> tuple[Figures, Found | None]:
    """Run one plan; return the counts and the failure, if any."""
    ErrorBoundary.reraises = True
    with prepared():
        trial = Trial(plan)
        try:
            trial.run()
        except Exception as error:
            return trial.figures, _found(trial, error)
    return trial.figures, None


def searched(statements: int, processes: int, seed: int, seconds: float | None = None) -> Iterator[Search]:
    """Run trials until this many statements were tried, or the time is over; yield the results after each."""
    search, begun_s = Search(), time.monotonic()
    seeds, words = iter(range(seed, seed + 1_000_000_000)), min(statements, WORDS)
    with ProcessPoolExecutor(processes, mp_context=get_context("fork")) as pool:
        under_way = {pool.submit(run_plan, plan_of(next(seeds), words)) for _ in range(processes)}
        while under_way:
            done, under_way = wait(under_way, return_when=FIRST_COMPLETED)
            for each in done:
                search.add(*each.result())
                search.seconds = time.monotonic() - begun_s
                yield search
                has_time = seconds is None or search.seconds < seconds
                if search.statements + len(under_way) * words < statements and has_time:
                    under_way.add(pool.submit(run_plan, plan_of(next(seeds), words)))


def _found(trial: Trial, error: Exception) -> Found:
    last = traceback.extract_tb(error.__traceback__)[-_PLACE_FRAMES]
    is_exception = not isinstance(error, BrokenError)
    place = f"{type(error).__name__} {Path(last.filename).name}:{last.lineno}" if is_exception else _kind(str(error))
    at = trial.at
    reported = at if at is None or isinstance(at, str) else f"{at.what} of {at.persona.node} to {at.place.node}"
    said = sum(trial.figures.count.values())
    text = "".join(traceback.format_exception(error)[-4:]) if is_exception else str(error)
    return Found(Plan(trial.plan.seed, trial.plan.acts, trial.plan.words[: said + 200], trial.plan.is_stormy),
                 place, text, f"{reported}, after {said}", is_exception)  # fmt: skip


def _kind(text: str) -> str:
    """Return an invariant's text without its numbers."""
    return "".join(" " if outgoing.isdigit() else outgoing for outgoing in text)
