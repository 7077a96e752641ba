"""Session with processes that play live nodes, from their start to their reports."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from rich.console import Console

from gdp.host.run_registry import Run, RunRegistry
from lab.process import FailedError, LabProcess
from lab.supervisor import Supervisor
from ring import live_run
from ring.live_run import LiveSession
from ring.result import Heard
from ring.traffic import ProgressReporter

HEAD = """
import json, signal, sys
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGUSR1])
def say(event, **fields): print(json.dumps(dict(event=event, **fields)), flush=True)
def wait(number):
    while signal.sigwait([signal.SIGINT, signal.SIGUSR1]) != number: pass
say('ready')
"""
SAYS = "say('progress', topic='/a', sent=1); say('done', sent=['aa', 'bb']);"
TALKER = HEAD + "wait(signal.SIGUSR1);" + SAYS + "signal.pause()"
LAMP = HEAD + "wait(signal.SIGINT); say('done', served=1); signal.pause()"
HEARS = "say('hears'); say('progress', topics=[dict(topic='/a', received=2)], latency_ms=1.5);"
LISTENER = HEAD + HEARS + "wait(signal.SIGINT); say('done'); signal.pause()"
CALLER = HEAD + "say('hears'); wait(signal.SIGUSR1); say('done', answered=1); signal.pause()"


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    started = RunRegistry(tmp_path / "runs").start()
    yield started
    started.end()


def play(run: Run, talker: str = TALKER, lamp: str = LAMP, listener: str = LISTENER, caller: str = CALLER) -> Heard:
    supervisor = Supervisor()
    codes = {"talker": talker, "lamp": lamp, "listener": listener, "caller": caller}
    with ExitStack() as stack:
        nodes = {
            name: stack.enter_context(LabProcess(run, name, [sys.executable, "-c", code]))
            for name, code in codes.items()
        }
        supervisor.ready(*nodes.values())
        session = LiveSession(supervisor, nodes, 2, 1, ProgressReporter(Console(file=io.StringIO())))
        session.meet()
        return session.talk(0.1)


def test_every_node_gets_the_start_command_and_is_asked_for_its_report(run: Run) -> None:
    heard = play(run)
    assert [talker["sent"] for talker in heard.talkers] == [["aa", "bb"]]
    assert (heard.lamp["served"], heard.caller["answered"]) == (1, 1)


def test_what_does_not_come_is_waited_for_only_while_something_moves(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_run, "QUIET_S", 0.2)
    heard = play(run, listener=LISTENER.replace("received=2", "received=1"))
    assert heard.listener["event"] == "done"


def test_a_node_that_does_not_report_is_named(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_run, "ENDING_S", 0.2)
    with pytest.raises(FailedError, match=r"lamp did not say 'done' within 0\.2 s"):
        play(run, lamp=HEAD + "signal.pause()")


def test_a_node_that_dies_ends_the_run_and_shows_its_last_lines(run: Run) -> None:
    with pytest.raises(FailedError, match=r"(?s)talker ended with code 1.*no such topic"):
        play(run, talker=HEAD + "wait(signal.SIGUSR1); sys.exit('no such topic')")
