"""Processes of a machine of the laboratory: what they print and log, how they end, and the files of their nodes."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from lab.machine import LabMachine
from lab.process import FailedError, calling

_TALKS = "import sys; print('one'); print('two', flush=True); print('logged', file=sys.stderr, flush=True); {}"
_ENDS = "import signal, sys; signal.signal(2, lambda *_: sys.exit(print('three'))); "
_WAITS = _ENDS + _TALKS.format("signal.pause()")


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[LabMachine]:
    with LabMachine(tmp_path) as made:
        yield made


def say(*words: str) -> None:
    """Print words; a process of its own."""
    print(*words)


def test_a_function_of_a_test_is_called_in_a_process_of_its_own(machine: LabMachine) -> None:
    assert machine.output(*calling(say, "a", 2)) == "a 2\n"


def test_lines_are_read_until_a_sign_and_the_rest_is_returned_at_the_end(machine: LabMachine) -> None:
    process = machine.launch([sys.executable, "-c", _WAITS])
    assert process.read_until("two", "three") == "two"
    assert process.finish() == "three\n"
    assert process.code == 0


def test_a_log_is_awaited_and_that_of_a_former_process_of_the_same_name_is_not_taken_for_it(
    machine: LabMachine,
) -> None:
    first = machine.launch([sys.executable, "-c", _WAITS], "node")
    assert first.until_logged("^log") == "logged"
    first.finish(signal.SIGKILL)
    silent = machine.launch([sys.executable, "-c", ""], "node")
    with pytest.raises(FailedError, match="ended before it logged"):
        silent.until_logged("^log")


def test_a_command_that_fails_says_what_it_printed(machine: LabMachine) -> None:
    failing = [sys.executable, "-c", _TALKS.format("sys.exit(3)")]
    with pytest.raises(FailedError, match=r"exit 3: one\ntwo\nlogged"):
        machine.output(*failing)
    with pytest.raises(FailedError, match=r"ended with code 3 after 'one"):
        machine.launch(failing).output()


def test_the_file_of_a_node_names_its_keys_and_the_root_among_them(machine: LabMachine) -> None:
    path = machine.write("robot/rib", "rib", iface="rib0")
    assert path == machine.folder / "robot/rib.yaml"
    assert yaml.safe_load(path.read_text()) == {
        "identity": "rib",
        "domain": {"root": "rib/root.crt"},
        "iface": "rib0",
    }
