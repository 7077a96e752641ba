"""Processes that are ended, and those that must not be."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from gdp.host.processes import Process, boot_id, end_all

STUBBORN = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); signal.pause()"
WILLING = "import signal; print(flush=True); signal.pause()"


@contextmanager
def running(program: str) -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, start_new_session=True) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            yield process
        finally:
            process.kill()


def test_a_running_process_is_alive_and_an_ended_one_is_not() -> None:
    with running(WILLING) as process:
        known = Process.from_pid(process.pid)
        assert known.alive
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert not known.alive  # although its parent has not reaped it yet
        process.wait()
        assert not known.alive
        with pytest.raises(ProcessLookupError):
            Process.from_pid(process.pid)


def test_a_process_is_ended_by_sigterm() -> None:
    with running(WILLING) as process:
        end_all([Process.from_pid(process.pid)])
        assert process.wait(5) == -signal.SIGTERM


def test_a_process_that_takes_no_notice_is_killed() -> None:
    with running(STUBBORN) as process:
        end_all([Process.from_pid(process.pid)], patience_s=0.1)
        assert process.wait(5) == -signal.SIGKILL


def test_an_id_that_another_process_has_now_is_left_alone() -> None:
    with running(WILLING) as process:
        known = Process.from_pid(process.pid)
        end_all([replace(known, started=known.started - 1)])
        assert known.alive


def test_a_process_that_is_gone_is_no_error() -> None:
    with running(WILLING) as process:
        known = Process.from_pid(process.pid)
        process.kill()
        process.wait()
        end_all([known])


def test_a_boot_has_an_id() -> None:
    assert len(boot_id()) == 36
