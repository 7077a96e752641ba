"""Lock for one process of each identity on a host."""

from __future__ import annotations

import hashlib
import logging
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gdp.errors import LocalError
from gdp.host import single_instance
from gdp.host.single_instance import own_devices, run_alone
from gdp.names import Name

NAME = Name(hashlib.sha256(b"one of each").digest())
_HOLD = """
import sys
from gdp.names import Name
from gdp.host import single_instance
from pathlib import Path
single_instance._ROOT_DIRECTORY = Path(sys.argv[2])
single_instance.lock_directory = lambda: single_instance._ROOT_DIRECTORY
with single_instance.run_alone("switch", Name.from_text(sys.argv[1])), single_instance.own_devices(["eth7"]):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def _directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(single_instance, "_ROOT_DIRECTORY", tmp_path / "locks")
    monkeypatch.setattr(single_instance, "lock_directory", lambda: tmp_path / "locks")


@contextmanager
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Process that holds the locks."""
    argv = [sys.executable, "-c", _HOLD, NAME.to_text(), str(tmp_path / "locks")]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "held\n"
            yield process
        finally:
            process.kill()


def hold() -> None:
    with run_alone("switch", NAME):
        pass


def test_a_second_process_with_the_same_identity_is_refused_with_the_pid_of_the_first(tmp_path: Path) -> None:
    with holder(tmp_path) as first, pytest.raises(LocalError, match=f"this switch already runs, pid {first.pid} "):
        hold()


def test_a_device_that_another_node_uses_is_refused_with_its_pid(tmp_path: Path) -> None:
    with holder(tmp_path) as first:
        refused = pytest.raises(LocalError, match=f"eth7 is in use .* pid {first.pid} ")
        with refused, own_devices(["eth6", "eth7"]):
            pass


def test_the_lock_of_a_killed_process_is_free(tmp_path: Path) -> None:
    with holder(tmp_path) as first:
        first.send_signal(signal.SIGKILL)
        first.wait()
        hold()


def test_the_lock_of_a_process_that_ended_is_free_and_leaves_no_file(tmp_path: Path) -> None:
    with holder(tmp_path) as first:
        first.communicate("")
        assert list((tmp_path / "locks").iterdir()) == []
        hold()


def test_another_user_sees_the_locks_of_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(single_instance, "lock_directory", lambda: tmp_path / "of-a-user")
    with holder(tmp_path), pytest.raises(LocalError, match="already runs"):
        hold()
    hold()


def test_where_no_lock_can_be_held_the_node_runs_and_a_warning_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(single_instance, "lock_directory", lambda: tmp_path / "nowhere" / "locks")
    with caplog.at_level(logging.WARNING):
        hold()
    assert "goes unnoticed" in caplog.text


def test_a_lock_directory_that_others_may_write_to_is_not_trusted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "locks").mkdir()
    (tmp_path / "locks").chmod(0o777)
    hold()
    assert "others must not write" in caplog.text
