"""Plugin of every run: forked programs, one pool of workers, and the seconds of each file with their budgets.

Programs of the project are forked, not executed; ``GDP_REAL_PROGRAMS=1`` and coverage start the real ones. Workers of
pytest-xdist take whole files, the longest first; a file of ``_SPLIT`` is divided into its tests. Processor seconds
count the test's own process and all processes that it started and waited for. Machines differ in speed, and so does one
machine under load; so a folder is compared with the median of all folders' ratios of seconds to budget.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import resource
import statistics
import time
from collections import defaultdict
from collections.abc import Collection, Container, Generator, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import pytest
from xdist.scheduler import LoadScopeScheduling

from lab import zygote

__all__ = ["OVER_BUDGET", "SECONDS", "folder_of"]

SECONDS: Final = Path(__file__).with_name("seconds.json")
OVER_BUDGET: Final = 6  # exit status of pytest where all tests passed
_REAL: Final = "GDP_REAL_PROGRAMS"
_SPLIT: Final = ("netns_tests/test_ring.py", "netns_tests/test_planes.py", "netns_tests/test_ring_live.py")
_EXCESS: Final = 1.5  # times its budget that a folder may take
_LEAST_S: Final = 20.0  # folders below this are too small to judge
_PROPERTY: Final = "seconds"  # of a report: wall clock, processor
_FILES_SHOWN: Final = 12
_UNKNOWN: Final = (10.0, 10.0)  # of a file that was not measured yet: it does not begin last


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of budgets."""
    group = parser.getgroup("pool", "seconds of files and folders")
    group.addoption("--seconds", metavar="FILE", type=Path, help="write the seconds of each file, as JSON")
    group.addoption("--budgets", action="store_true", help="fail if a folder takes half more than its budget")
    group.addoption("--save-budgets", action="store_true", help="budgets become the lesser of old and present seconds")


def pytest_configure(config: pytest.Config) -> None:
    """Start a zygote for the processes of this session, and the clock of its tests."""
    is_controller = bool(getattr(config.option, "numprocesses", None)) and not hasattr(config, "workerinput")
    is_measured = bool(config.getoption("--cov", None))
    if not (is_controller or is_measured or os.environ.get(_REAL) == "1"):
        zygote.install()
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Seconds(config), "seconds")


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Note when a test began."""
    item.stash[_BEGAN] = time.perf_counter(), _processor_s()
    return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None, None, None]:
    """Add the seconds to the last report of a test."""
    try:
        yield
    finally:
        began, processor = item.stash[_BEGAN]
        item.user_properties.append((_PROPERTY, (time.perf_counter() - began, _processor_s() - processor)))


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Collect without garbage collections: all that is made stays, and later ones need not visit it.

    Each worker imports a share of the files first, so that one of them compiles a file and the others read the result.
    """
    gc.disable()
    try:
        for file in _share_of(session.config):
            with contextlib.suppress(Exception, pytest.skip.Exception):  # the collection meets it again, and says so
                importlib.import_module(".".join(file.relative_to(session.config.rootpath).with_suffix("").parts))
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def _share_of(config: pytest.Config) -> list[Path]:
    """Return the files that a worker imports first; none where there is one process."""
    worker: Mapping[str, Any] | None = getattr(config, "workerinput", None)
    if worker is None:
        return []
    roots = [config.invocation_params.dir / each.partition("::")[0] for each in config.args]
    files = sorted(file for root in roots for file in root.rglob("test_*.py"))
    return files[int(worker["workerid"].removeprefix("gw")) :: worker["workercount"]]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put the longest files first, where several workers share them."""
    if hasattr(config, "workerinput"):
        known = _known()
        items.sort(key=lambda item: -known.get(_file_of(item.nodeid), _UNKNOWN)[0])


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> _Files:
    """Return the scheduler of whole files."""
    config.option.loadscopereorder = False
    return _Files(config, log)


class _Files(LoadScopeScheduling):  # type: ignore[misc]  # it has no types
    """Files are units of work; those of ``_SPLIT`` are as many units as they have tests.

    Some files compute, others wait. While the other workers compute more than files do on average, a worker gets the
    longest file that computes less, otherwise the longest that computes more: the cores are busy from begin to end.
    """

    def __init__(self, config: pytest.Config, log: Any) -> None:
        super().__init__(config, log)
        self._known = _known()
        self._shares: dict[object, float] = {}  # by worker: cores that its last unit keeps busy

    def _split_scope(self, nodeid: str) -> str:
        file = _file_of(nodeid)
        return nodeid if file in _SPLIT else file

    def _assign_work_unit(self, node: Any) -> None:
        others = [share for each, share in self._shares.items() if each is not node]
        unit = _next_unit(self.workqueue, self._known, others)
        self._shares[node] = _share(self._known, [unit])
        self.workqueue.move_to_end(unit, last=False)
        super()._assign_work_unit(node)


class _Seconds:
    """Sums of the seconds by file, in the process that reports."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._files: defaultdict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
        self._skipped: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add the seconds of a test, which stand in its last report."""
        if report.skipped:
            self._skipped.add(_file_of(report.nodeid))
        if report.when == "teardown":
            values: list[Any] = [value for name, value in report.user_properties if name == _PROPERTY]
            for wall_s, processor_s in values:
                row = self._files[_file_of(report.nodeid)]
                row[0] += wall_s
                row[1] += processor_s

    @pytest.hookimpl(wrapper=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> Generator[None, None, None]:
        """Fail a run whose folders exceed their budgets; write and save the seconds."""
        known, option = _known(), self._config.option
        pace = _pace(_folders(self._files), _folders(known))
        files = {file: [wall / pace, processor / pace] for file, (wall, processor) in sorted(self._files.items())}
        if option.seconds:
            option.seconds.parent.mkdir(parents=True, exist_ok=True)
            _write(option.seconds, files)
        self._rows = [(folder, spent, _folders(known).get(folder)) for folder, spent in _folders(files).items()]
        self._over = [each[0] for each in self._rows if _is_over(each[1], each[2])] if option.budgets else []
        if option.save_budgets:
            _write(SECONDS, _lesser(known, files, self._skipped))
        if self._over and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = OVER_BUDGET
        yield

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Print the folders, and the files that took longest."""
        if not (self._config.option.budgets or self._config.option.seconds):
            return
        terminalreporter.section("processor seconds by folder")
        for folder, spent, budget in sorted(self._rows, key=lambda row: -row[1]):
            text = f"{spent:8.0f} of {budget:.0f}" if budget else f"{spent:8.0f}"
            terminalreporter.line(f"{text:20} {folder}{'  OVER BUDGET' if folder in self._over else ''}")
        terminalreporter.section("files that took longest: seconds, processor seconds")
        for file, (wall_s, processor_s) in sorted(self._files.items(), key=lambda row: -row[1][0])[:_FILES_SHOWN]:
            terminalreporter.line(f"{wall_s:8.0f} {processor_s:8.0f} {file}")
        for folder in self._over:
            terminalreporter.line(f"{folder}: half more than its budget in {SECONDS.name}; make it faster, or raise it")


def folder_of(file: str) -> str:
    """Return the folder whose budget a file belongs to: ``netns_tests``, ``tests/attacks``, ``tests/gdp/switch``."""
    parts = Path(file).parent.parts
    return "/".join(parts[: 3 if parts[1:2] in (("gdp",), ("proxy",), ("fog",), ("gdp_extensions",)) else 2])


def _folders(files: Mapping[str, Iterable[float]]) -> dict[str, float]:
    sums: defaultdict[str, float] = defaultdict(float)
    for file, (_, processor_s) in files.items():
        sums[folder_of(file)] += processor_s
    return dict(sums)


def _lesser(
    old: Mapping[str, list[float]], new: Mapping[str, list[float]], skipped: Container[str] = ()
) -> dict[str, list[float]]:
    """Return the budgets; a file that skipped tests keeps its own, for it did less than elsewhere."""
    known = {file: old.get(file, row) for file, row in new.items()}
    return {
        file: row if file in skipped else [min(pair) for pair in zip(row, new[file], strict=True)]
        for file, row in known.items()
    }


def _is_over(spent_s: float, budget_s: float | None) -> bool:
    return budget_s is not None and spent_s > _EXCESS * max(budget_s, _LEAST_S)


def _pace(spent: Mapping[str, float], budgets: Mapping[str, float]) -> float:
    """Return how many of this machine's seconds one second of a budget is: the median of large folders."""
    ratios = [spent[folder] / budget for folder, budget in budgets.items() if budget >= _LEAST_S and spent.get(folder)]
    return statistics.median(ratios) if ratios else 1.0


def _known() -> dict[str, list[float]]:
    content: dict[str, list[float]] = json.loads(SECONDS.read_text(encoding="utf-8"))
    return content


def _write(path: Path, files: Mapping[str, list[float]]) -> None:
    rows = ",\n".join(f"  {json.dumps(name)}: [{wall:.1f}, {spent:.1f}]" for name, (wall, spent) in files.items())
    path.write_text(f"{{\n{rows}\n}}\n", encoding="utf-8")


def _next_unit(queue: Collection[str], known: Mapping[str, Sequence[float]], others: Collection[float]) -> str:
    """Return the unit of work for a worker; ``others``: how many cores each other worker keeps busy."""
    usual = _share(known, queue)
    is_idle = sum(others) <= usual * len(others)
    return next((unit for unit in queue if (_share(known, [unit]) > usual) is is_idle), next(iter(queue)))


def _share(known: Mapping[str, Sequence[float]], units: Iterable[str]) -> float:
    """Return how many cores the files of some units of work keep busy."""
    rows = [known.get(file, _UNKNOWN) for file in {*map(_file_of, units)}]
    return sum(processor_s for _, processor_s in rows) / max(sum(wall_s for wall_s, _ in rows), 0.1)


def _file_of(nodeid: str) -> str:
    return nodeid.partition("::")[0]


def _processor_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


_BEGAN: Final = pytest.StashKey[tuple[float, float]]()
