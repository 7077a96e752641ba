"""A forked program is the same as an executed one, to its caller and to the kernel."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from gdp.ports.readiness import readable
from lab.zygote import Popen, Program, Zygote
from tests.pages import ROOT

_BIN = Path(sys.executable).parent
SCRIPTS = sorted(
    each.name for each in importlib.metadata.distribution("gdp-ros").entry_points.select(group="console_scripts")
)
PROBE = str(ROOT / "tests/scripts/lab/probe.py")

Start = Callable[..., "Popen"]


@pytest.fixture(scope="module")
def forked() -> Zygote:
    """Zygote of the session, or one of its own where programs are executed."""
    return Popen.zygote or Zygote.start()


@pytest.fixture(params=["forked", "executed"])
def start(request: pytest.FixtureRequest, forked: Zygote, monkeypatch: pytest.MonkeyPatch) -> Start:
    """Start a program either way."""
    monkeypatch.setattr(Popen, "zygote", forked if request.param == "forked" else None)
    return Popen


def said(process: subprocess.Popen[str]) -> dict[str, Any]:
    """Return what the probe has printed; it has ended well."""
    out, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    found: dict[str, Any] = json.loads(out)
    return found


def output(argv: Sequence[str], **more: Any) -> tuple[int, str, str]:
    """Return exit status, output and errors of a command."""
    pipe = subprocess.PIPE
    with Popen(argv, stdout=pipe, stderr=pipe, stdin=subprocess.DEVNULL, text=True, **more) as process:
        out, errors = process.communicate(timeout=60)
    return process.returncode, out, errors


@pytest.mark.parametrize(
    "script", [each if each == "gdp-replay" else pytest.param(each, marks=pytest.mark.nightly) for each in SCRIPTS]
)
def test_each_command_says_the_same(script: str, forked: Zygote, monkeypatch: pytest.MonkeyPatch) -> None:
    argv = [str(_BIN / script), "--help"]
    monkeypatch.setattr(Popen, "zygote", forked)
    assert Program.from_argv(argv) is not None
    short = output(argv)
    monkeypatch.setattr(Popen, "zygote", None)
    assert short == output(argv)


def test_it_has_the_callers_surroundings(start: Start, tmp_path: Path) -> None:
    environment = {**os.environ, "SEEN": "yes", "PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ['PYTHONPATH']}"}
    reads, writes = os.pipe()
    words = [sys.executable, PROBE, "a word"]
    process = start(
        words,
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        pass_fds=[writes],
        umask=0o27,
        start_new_session=True,
    )
    seen = said(process)
    assert seen["argv"] == words[1:]
    assert seen["cwd"] == str(tmp_path)
    assert seen["seen"] == "yes"
    assert seen["path"][:2] == [str(Path(PROBE).parent), str(tmp_path)]
    assert seen["descriptors"] == [0, 1, 2, writes]
    assert seen["umask"] == 0o27
    assert seen["pid"] == seen["session"] == seen["group"] == process.pid
    assert seen["parent"] == os.getpid()
    assert seen["net"] == os.readlink("/proc/self/ns/net")
    assert seen["command"] == words
    for each in (reads, writes):
        os.close(each)


def test_without_a_session_of_its_own_it_is_in_the_callers_group(start: Start) -> None:
    seen = said(start([sys.executable, PROBE], stdout=subprocess.PIPE, text=True))
    assert (seen["session"], seen["group"]) == (os.getsid(0), os.getpgid(0))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL, signal.SIGINT])
def test_a_signal_ends_it(start: Start, number: signal.Signals) -> None:
    with start([sys.executable, PROBE, "--wait"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "waiting\n"
        process.send_signal(number)
        process.communicate(timeout=60)
    assert process.returncode == -number


def test_its_exit_status_and_its_errors_are_its_own(start: Start) -> None:
    with start([sys.executable, PROBE, "--fail"], stderr=subprocess.PIPE, text=True) as process:
        errors = process.communicate(timeout=60)[1]
    assert process.returncode == 1
    assert errors.endswith("ValueError: as asked\n")


def test_it_ends_as_an_interpreter_does(start: Start) -> None:
    with start([sys.executable, PROBE, "--end"], stdout=subprocess.PIPE, text=True) as process:
        out, _ = process.communicate(timeout=60)
    assert (process.returncode, out) == (7, "in a thread\nat its end\n")


def test_an_output_that_nothing_reads_is_an_error(start: Start) -> None:
    reads, writes = os.pipe()
    os.close(reads)
    with start([sys.executable, PROBE], stdout=writes, stderr=subprocess.PIPE, text=True) as process:
        os.close(writes)
        errors = process.communicate(timeout=60)[1]
    assert "BrokenPipeError" in errors
    assert process.returncode != 0


@pytest.mark.parametrize("how", ["forked", "executed"])
def test_it_dies_with_its_caller(how: str) -> None:
    leash = ["setpriv", "--pdeathsig", "KILL", "--"]
    code = (
        "import os, subprocess, sys; from lab import zygote; zygote.install() if sys.argv[1] == 'forked' else None; "
        f"child = subprocess.Popen([*{leash}, sys.executable, {PROBE!r}, '--wait'], stdout=subprocess.PIPE); "
        "child.stdout.readline(); print(child.pid, flush=True); os.kill(os.getpid(), 9)"
    )
    with subprocess.Popen([sys.executable, "-c", code, how], stdout=subprocess.PIPE, text=True) as caller:
        assert caller.stdout is not None
        orphan = int(caller.stdout.readline())
        with contextlib.suppress(ProcessLookupError):
            descriptor = os.pidfd_open(orphan)
            assert readable([descriptor], 60.0), "it lives on"
            os.close(descriptor)


@pytest.mark.parametrize(
    "argv",
    [
        ["sleep", "0"],
        [sys.executable, "-c", "pass"],
        [sys.executable, "-c", "import gdp"],
        [sys.executable, "-I", "-m", "gdp.cli.gdp"],
        ["setpriv", "--reuid", "1", sys.executable, "-m", "gdp.cli.gdp"],
        ["/usr/bin/python3", "-m", "gdp.cli.gdp"],
    ],
)
def test_what_is_not_plainly_a_program_of_the_project_is_executed(argv: list[str]) -> None:
    assert Program.from_argv(argv) is None


def test_another_copy_of_the_project_is_executed(forked: Zygote, tmp_path: Path) -> None:
    (tmp_path / "gdp").mkdir()
    program = Program.from_argv([sys.executable, "-m", "gdp.cli.gdp"])
    assert program is not None
    assert forked.can_run(program, dict(os.environ), ROOT)
    assert not forked.can_run(program, dict(os.environ), tmp_path)
    assert not forked.can_run(program, {**os.environ, "PYTHONPATH": str(tmp_path)}, ROOT)
    assert not forked.can_run(program, {**os.environ, "PYTHONHASHSEED": "7"}, ROOT)
    own = os.environ.get("LD_LIBRARY_PATH", "")
    assert not forked.can_run(program, {**os.environ, "LD_LIBRARY_PATH": f"{tmp_path}{os.pathsep}{own}"}, ROOT)


def test_code_that_imports_the_project_is_forked_on_a_machine_of_a_laboratory() -> None:
    entered = ["nsenter", "--net=/run/netns/s1", "--", sys.executable, "-c"]
    program = Program.from_argv([*entered, "import sys\nfrom gdp import names"])
    assert program is not None
    assert program.code.startswith("import sys")
    assert Program.from_argv([*entered, "import gdprint"]) is None


def test_what_a_shell_does_before_a_command_is_done_before_the_forked_one() -> None:
    words = ["nsenter", "--net=/n", "--", "bash", "-c", "exec nsenter --mount=/m -- env A=b gdp join"]
    program = Program.from_argv(words, str(_BIN))
    assert program is not None
    assert (program.spaces, program.environment) == (("/n", "/m"), (("A", "b"),))
    assert program.argv[1:] == ["join"]


@pytest.mark.skipif(Popen.zygote is None, reason="this session executes programs")
def test_no_import_of_a_test_makes_the_session_execute_its_programs(tmp_path: Path) -> None:
    program = Program.from_argv([sys.executable, "-m", "gdp.cli.gdp"])
    assert program is not None
    assert Popen.zygote is not None
    assert Popen.zygote.can_run(program, dict(os.environ), ROOT), "what all tests import has changed its surroundings"
    missing = f"{tmp_path / 'missing'}{os.pathsep}{os.environ.get('LD_LIBRARY_PATH', '')}"  # as cv2 does
    assert Popen.zygote.can_run(program, {**os.environ, "LD_LIBRARY_PATH": missing}, ROOT)
