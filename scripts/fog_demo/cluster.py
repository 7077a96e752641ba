"""Cluster of ``fog`` with the provider ``local``: machines that serve, a robot, and a node there that calls.

I/O. The demonstration and figures 4 and 9 run on it. Resources of ``fog`` outlive this process, like
machines of a cloud. A run therefore ends with ``fog down``, and records lead to the leftovers of a killed run. The
records are in a separate folder, which no other program sweeps.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Final, TypeVar

from fog.providers.local import fault_injection
from fog.site import open_site
from fog.supervisor.core.record import Record
from fog.supervisor.infrastructure import local_provider
from fog.supervisor.journal import Entry, Journal
from gdp.errors import LocalError
from gdp.host.run_registry import Run, RunRegistry, outer_uid
from lab.dds import ros_environment
from lab.machine import LabMachine
from lab.namespaces import Namespaces
from lab.process import Event, LabProcess, UndoneOnExit, until
from lab.topology import single

DEDICATED, REPLICA = "dedicated", "replica"
ROBOT: Final = "robot"
STATE: Final = "state"
_DOMAIN: Final = 30
_REPORT_S: Final = 0.5
_DEPTH: Final = 1_000  # answers to all calls of an outage come in one burst
_PATIENCE_S: Final = 90.0
_LAUNCH_S: Final = 200.0
_DOWN_S: Final = 60.0

T = TypeVar("T")


def standing_runs(what: str) -> RunRegistry:
    """Return the records of runs of one kind, such as ``demo``, with machines of ``fog``.

    Raises ``LocalError``: the folder belongs to another user.
    """
    return RunRegistry(Path(tempfile.gettempdir()) / f"gdp-fog-{what}-{outer_uid()}")


def sweep(runs: RunRegistry) -> list[str]:
    """Take down the leftovers of killed runs; return their ids."""
    dead = [each.run for each in runs.all() if each.dead]
    for run in dead:
        end_all_of(runs.resume(run))
    return dead


def end_all_of(run: Run) -> None:
    """Release the machines of a run, and take down the rest.

    Raises ``LocalError``: machines remain; the text has the output of ``fog down``.
    """
    if (run.directory / STATE).exists():
        argv = [sys.executable, *_fog_command(run, ["down", "--all"])]
        ended = LabMachine(Path()).run(*argv, patience_s=_DOWN_S)
        if ended.returncode:
            raise LocalError(f"run {run.id}: fog down: {(ended.stderr or ended.stdout).strip()}")
    run.end()


def _fog_command(run: Run, words: Sequence[str]) -> list[str]:
    return ["-m", "fog.cli.app", *words, "--state", str(run.directory / STATE)]


def _note(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class Cluster(UndoneOnExit):
    """Replicas that serve, and a robot; a context manager that removes everything.

    Args:
        launch_files: their texts; each has one ``FogCluster``.
        machines: how many they have.
        gateway: ``DEDICATED`` or ``REPLICA``.
        kind: of the run's records.
        note: shows progress.

    Attributes:
        meanwhile: is called while this waits, and waits a moment itself; None: nothing is.

    Raises:
        LocalError: the kernel refuses.
        FailedError: a process did not come up.
    """

    def __init__(
        self,
        launch_files: Sequence[str],
        machines: int,
        gateway: str,
        *,
        kind: str = "bench",
        note: Callable[[str], object] = _note,
    ) -> None:
        self.meanwhile: Callable[[], object] | None = None
        self._note = note
        self._machines_wanted = machines
        runs = standing_runs(kind)
        for swept in sweep(runs):
            note(f"took down what run {swept} had left behind")
        self._run = runs.start()
        with ExitStack() as undo:
            undo.callback(end_all_of, self._run)
            self._space = Namespaces(single(ROBOT), self._run)[ROBOT]
            enter = self._space.command(["env", *ros_environment(self._run.directory, _DOMAIN)])
            self._robot = undo.enter_context(LabMachine(self._run.directory, enter, run=self._run))
            note(f"{machines} machines boot, gateway: {gateway}")
            path = self._run.directory / "cluster.launch.py"
            for text in launch_files:
                path.write_text(text, encoding="utf-8")
                self._fog("launch", str(path), "--detach", "--gateway", gateway)
            self._site = open_site(None, self._run.directory / STATE)
            self._journal = undo.enter_context(closing(Journal(self._site.journal)))
            self._until(lambda: all(each.is_serving for each in self.machines()), "all machines that serve")
            self._runs = local_provider(self._site).runs
            self._undo = undo.pop_all()

    def call(self, rate_hz: float) -> None:
        """Let the robot's node call ``/echo``; return when it is answered."""
        parameters = {"rate_hz": rate_hz, "report_s": _REPORT_S, "depth": _DEPTH}
        words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        self._caller = self._undo.enter_context(self.start("caller", ["-m", "fog_demo.caller", "--ros-args", *words]))
        self._until(lambda: self._caller.read(_PATIENCE_S)["answered"], "an answer to the robot's node")

    def reports(self) -> Iterator[Event]:
        """Yield the lines that the robot's node has printed since the last one was read."""
        while self._caller.has_line(0.0):
            yield self._caller.read(_PATIENCE_S)

    def oldest(self) -> Record:
        """Return the machine that has served for longest."""
        serving = [each for each in self.machines() if each.is_serving]
        return min(serving, key=lambda each: each.served_unix_s or 0.0)

    def notice(self, machine: Record, seconds: float) -> None:
        """Send a machine its preemption notice."""
        fault_injection.notice(self._runs, machine.id, seconds)

    def kill(self, machine: Record) -> None:
        """Kill all processes of a machine, and unplug it."""
        fault_injection.kill(self._runs, machine.id)

    def machines(self, *, gone: bool = False) -> list[Record]:
        """Return all machines; ``gone``: those that are gone, too."""
        plans = (each.plan for each in self._journal.clusters())
        return [each for plan in plans for each in self._journal.machines(plan.name, gone=gone)]

    def events(self, after: int = 0) -> list[Entry]:
        """Return the journal's events whose number is above ``after``."""
        return self._journal.events(after=after)

    def replacement(self, after_s: float) -> Record | None:
        """Return the first machine that was requested after this moment and serves."""
        return next((each for each in self.machines() if each.asked_unix_s >= after_s and each.is_serving), None)

    def await_replacement(self, after_s: float) -> Record:
        """Return the replacement when it serves."""
        return self._until(lambda: self.replacement(after_s), "a replacement that serves")

    def await_event(self, machine: str, what: set[str], after_s: float) -> float:
        """Return when one of these events was recorded of a machine, in seconds since 1970."""

        def written() -> float | None:
            found = (e.unix_s for e in self._journal.events() if e.machine == machine and e.what in what)
            return next((unix_s for unix_s in found if unix_s >= after_s), None)

        return self._until(written, f"{machine}: {' or '.join(sorted(what))}")

    def await_whole(self, victim: Record) -> None:
        """Return when this machine is gone and the wanted number of other machines serve."""

        def is_whole() -> bool:
            there = self.machines()
            is_rid = all(each.name != victim.name for each in there)
            return is_rid and len(there) == self._machines_wanted and all(each.is_serving for each in there)

        self._until(is_whole, "as many machines as are wanted that serve, and no other")

    def end_caller(self) -> Event:
        """End the robot's node; return its last line, in which all calls have ended. Its complaints are noted."""
        os.kill(self._caller.pid, signal.SIGUSR1)
        while not (said := self._caller.read(_PATIENCE_S))["done"]:
            pass  # an earlier line of progress
        for line in self._caller.log.read_text(encoding="utf-8", errors="replace").splitlines():
            self._note(f"caller: {line}")
        return said

    def start(self, what: str, arguments: Sequence[str]) -> LabProcess:
        """Start Python at the robot, with the environment of ROS; ``what`` names its log."""
        return self._robot.launch([sys.executable, *arguments], what)

    def inside(self, work: Callable[[], T]) -> T:
        """Call ``work`` in the robot's namespace."""
        return self._space.inside(work)

    def _fog(self, *words: str) -> None:
        self._robot.output(sys.executable, *_fog_command(self._run, words), patience_s=_LAUNCH_S)

    def _until(self, found: Callable[[], T | None], what: str) -> T:
        """Poll until a state is reached that sends no event."""
        value = until(found, lambda: what, _PATIENCE_S, self.meanwhile)
        assert value
        return value


def requests_in(said: Event) -> tuple[int, int]:
    """Return how many requests a line of the robot's node counts, and how many of them failed.

    Requests that were not sent for lack of a server count; those under way have failed in the last line.
    """
    left = said["under_way"] if said["done"] else 0
    return said["calls"] + said["unserved"], said["failed"] + said["wrong"] + said["unserved"] + left
