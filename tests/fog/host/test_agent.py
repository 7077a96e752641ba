"""``fog-machine`` as a process: its programs, its status, its end."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from fog.host.bundle import install
from fog.host.preemption_notice import write_notice
from fog.host.status import Status
from fog.machine import MachineBundle, MachineState, Program

_PATIENCE_S = 20.0
SAYS_READY = "import signal, sys, time; print('now ready'); "
WAITS = SAYS_READY + "time.sleep(1000)"
TELLS = "signal.signal({}, lambda *_: (open('signalled', 'a').write('{} '), sys.exit())); "

Start = Callable[..., "subprocess.Popen[str]"]


def program(name: str, code: str = WAITS, *, restarts: bool = True) -> Program:
    return Program(name, ("{python}", "-c", code), "ready", restarts=restarts)


def teller(name: str, number: str = "signal.SIGTERM") -> Program:
    return program(name, "import signal, sys; " + TELLS.format(number, name) + WAITS)


def until(home: Path, is_met: Callable[[Status], bool]) -> Status:
    """Poll until a machine's status is as wanted; no event reports a change."""
    end_s = time.monotonic() + _PATIENCE_S
    while True:
        status = Status.read(home)
        if status is not None and is_met(status):
            return status
        assert time.monotonic() < end_s, status
        time.sleep(0.01)


def pid_of(status: Status, name: str) -> int:
    pid = status.programs[name].pid
    assert pid is not None
    return pid


def until_gone(*pids: int) -> None:
    for pid in pids:
        with suppress(ProcessLookupError):
            fd = os.pidfd_open(pid)
            try:
                assert select.select([fd], [], [], _PATIENCE_S)[0], f"{pid} still runs"
            finally:
                os.close(fd)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    started: list[subprocess.Popen[str]] = []

    def begin(*programs: Program, options: tuple[str, ...] = ()) -> subprocess.Popen[str]:
        install(tmp_path, MachineBundle({}, programs))
        argv = [sys.executable, "-m", "fog.host.cli", "--home", str(tmp_path), *options]
        process = subprocess.Popen(
            argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.communicate()


def running(status: Status) -> bool:
    return status.state is MachineState.RUNNING


def test_programs_are_ended_in_the_reverse_order(start: Start, tmp_path: Path) -> None:
    host = start(teller("a"), teller("b"))
    until(tmp_path, running)
    host.terminate()
    said, _ = host.communicate(timeout=_PATIENCE_S)
    assert (tmp_path / "signalled").read_text() == "b a "
    assert said == "machine ends: was asked to end\n"
    last = Status.read(tmp_path)
    assert last is not None
    assert last.state is MachineState.GONE
    assert "now ready" in (tmp_path / "logs" / "a.log").read_text()


def test_a_machine_is_booting_until_all_its_programs_are_ready(start: Start, tmp_path: Path) -> None:
    start(program("a", "import time; time.sleep(1000)"), program("b"))
    status = until(tmp_path, lambda status: status.programs["b"].up)
    assert status.state is MachineState.BOOTING
    assert not status.programs["a"].up


def test_a_program_that_dies_is_started_again(start: Start, tmp_path: Path) -> None:
    start(program("a"))
    first = until(tmp_path, running)
    os.kill(pid_of(first, "a"), signal.SIGKILL)
    again = until(tmp_path, lambda status: status.programs["a"].restarts == 1 and status.programs["a"].up)
    assert pid_of(again, "a") != pid_of(first, "a")
    assert again.state is MachineState.RUNNING


def test_the_end_of_a_program_that_is_not_to_be_restarted_ends_the_machine(start: Start, tmp_path: Path) -> None:
    host = start(program("a"), program("b", SAYS_READY + "sys.exit(3)", restarts=False))
    host.wait(timeout=_PATIENCE_S)
    status = Status.read(tmp_path)
    assert status is not None
    assert (status.state, status.reason) == (MachineState.GONE, "b ended with code 3")


def test_a_drained_machine_lets_its_proxy_finish_before_the_rest_ends(start: Start, tmp_path: Path) -> None:
    host = start(teller("switch"), teller("proxy", "signal.SIGUSR1"), teller("node"))
    until(tmp_path, running)
    host.send_signal(signal.SIGUSR1)
    host.wait(timeout=_PATIENCE_S)
    assert (tmp_path / "signalled").read_text() == "proxy node switch "
    status = Status.read(tmp_path)
    assert status is not None
    assert status.reason == "drained"


def test_a_killed_machine_takes_its_programs_with_it(start: Start, tmp_path: Path) -> None:
    host = start(program("a"), program("b"))
    status = until(tmp_path, running)
    host.kill()
    until_gone(pid_of(status, "a"), pid_of(status, "b"))


def test_what_a_program_left_behind_ends_with_it(start: Start, tmp_path: Path) -> None:
    leaves = "import subprocess; pid = subprocess.Popen(['sleep', '1000']).pid; open('child', 'w').write(str(pid)); "
    start(program("a", leaves + WAITS))
    status = until(tmp_path, running)
    os.kill(pid_of(status, "a"), signal.SIGKILL)
    until_gone(int((tmp_path / "child").read_text()))


def test_a_machine_is_switched_off_at_the_moment_of_its_notice(start: Start, tmp_path: Path) -> None:
    host = start(program("a"))
    first = until(tmp_path, running)
    write_notice(tmp_path, time.time() + 0.2)
    host.send_signal(signal.SIGUSR2)
    until(tmp_path, lambda status: (status.state, status.reason) == (MachineState.LEAVING, "preempted"))
    assert host.wait(timeout=_PATIENCE_S) == -signal.SIGKILL
    until_gone(pid_of(first, "a"))


def test_a_machine_without_a_record_does_not_begin(start: Start, tmp_path: Path) -> None:
    host = start(program("a"), options=("--await-go",))
    host.communicate(timeout=_PATIENCE_S)
    assert host.returncode == 1
    assert Status.read(tmp_path) is None


def test_a_folder_without_a_boot_is_refused(tmp_path: Path) -> None:
    argv = [sys.executable, "-m", "fog.host.cli", "--home", str(tmp_path)]
    ended = subprocess.run(argv, capture_output=True, text=True, check=False, timeout=_PATIENCE_S)
    assert ended.returncode == 2
    assert "boot.json" in ended.stderr
