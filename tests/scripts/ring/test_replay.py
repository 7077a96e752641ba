"""Processes that play the two ends: the ring's treatment of their output and their exits."""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from rich.console import Console

from gdp.host.run_registry import Run, RunRegistry
from lab.process import Event, FailedError, LabProcess
from lab.supervisor import Supervisor
from ring import run as replay_module
from ring.faults import fault_from_text, text_of
from ring.overlay import Injection
from ring.result import Result
from ring.run import Replay
from ring.traffic import ProgressReporter

HEAD = """
import json, signal, sys
def say(**fields): print(json.dumps(fields), flush=True)
"""
SENDER = HEAD + "say(event='ready'); say(event='progress', sent=2); say(event='done', unread=None, unconfirmed=[])"
RECEIVER = """
def finish(*_): say(event='done', topics=[{'topic': '/a'}]); sys.exit(0)
signal.signal(signal.SIGINT, finish); say(event='ready'); say(event='progress', received=2, lost=0, latency_ms=1.5)
while True: signal.pause()
"""
RECEIVER = HEAD + RECEIVER


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    started = RunRegistry(tmp_path / "runs").start()
    yield started
    started.end()


def play(run: Run, sender: str, receiver: str, reported: io.StringIO | None = None) -> tuple[Sequence[Event], Result]:
    reporter = ProgressReporter(Console(file=reported or io.StringIO(), width=120))

    supervisor = Supervisor()
    with LabProcess(run, "receiver", [sys.executable, "-c", receiver]) as far:
        supervisor.ready(far)
        with LabProcess(run, "sender", [sys.executable, "-c", sender]) as near:
            supervisor.wait_for(near, "ready", 10)
            replay = Replay(supervisor, near, far, 2, reporter)
            report = replay.report(Injection(supervisor, (), lambda *_: None))
            return replay.topics, report


def test_when_the_sender_has_finished_the_receiver_is_asked_for_its_report(run: Run) -> None:
    topics, report = play(run, SENDER, RECEIVER)
    assert [topic["topic"] for topic in topics] == ["/a"]
    assert report.complaints == ()
    assert report.unread is None


def test_what_could_not_be_read_is_passed_on(run: Run) -> None:
    _, report = play(run, SENDER.replace("unread=None", "unread='cut off'"), RECEIVER)
    assert report.unread == "cut off"


def test_what_was_never_confirmed_is_a_complaint_that_names_the_topic(run: Run) -> None:
    lacking = "unconfirmed=[{'topic': '/imu', 'messages': 9, 'confirmed': 7}]"
    _, report = play(run, SENDER.replace("unconfirmed=[]", lacking), RECEIVER)
    assert report.complaints == ("/imu: 2 of 9 were never confirmed",)


def test_an_end_that_ends_badly_is_a_complaint(run: Run) -> None:
    _, report = play(run, SENDER + "; sys.exit(1)", RECEIVER.replace("sys.exit(0)", "sys.exit(3)"))
    assert report.complaints == ("the sender ended with code 1", "the receiver ended with code 3")


def test_a_sender_that_dies_in_the_middle_is_reported_with_its_last_lines(run: Run) -> None:
    with pytest.raises(FailedError, match=r"(?s)sender ended with code 1 in the middle\n    a boom"):
        play(run, HEAD + "say(event='ready'); sys.exit('a boom')", RECEIVER)


def test_a_process_that_never_gets_ready_is_reported_with_its_last_lines(run: Run) -> None:
    with pytest.raises(FailedError, match=r"(?s)receiver ended with code 1 before it said 'ready'\n    no such key"):
        play(run, SENDER, "import sys; sys.exit('no such key')")


def test_the_death_of_a_process_that_must_stand_ends_the_wait_at_once(run: Run) -> None:
    dying = HEAD + "say(event='ready'); sys.exit('fell over')"
    waiting = HEAD + "say(event='ready'); signal.pause()"
    with pytest.raises(FailedError, match=r"receiver ended with code 1\n    fell over"):
        play(run, waiting, dying)


def test_traffic_that_stands_still_ends_the_run(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_module, "STALL_S", 0.2)
    with pytest.raises(FailedError, match=r"nothing moved for 0\.2 s: .*delivered 2"):
        play(run, HEAD + "say(event='ready'); signal.pause()", RECEIVER)


def test_a_line_of_a_megabyte_is_read(run: Run) -> None:
    long = RECEIVER.replace("'/a'", "'/' + 'a' * 1_000_000")
    topics, _ = play(run, SENDER, long)
    assert len(topics[0]["topic"]) == 1_000_001


def test_a_process_that_does_not_answer_in_time_is_reported(run: Run) -> None:
    mute = LabProcess(run, "mute", [sys.executable, "-c", "import signal; signal.pause()"])
    with mute, pytest.raises(FailedError, match=r"mute did not say 'ready' within 0\.05 s"):
        Supervisor().wait_for(mute, "ready", 0.05)


def test_faults_are_injected_at_their_seconds_and_those_that_come_too_late_are_complaints(run: Run) -> None:
    supervisor, injected = Supervisor(), list[str]()
    cuts = [fault_from_text("cut", "a-b@0-0.05"), fault_from_text("cut", "a-c@60")]
    injection = Injection(supervisor, cuts, lambda fault, begins: injected.append(f"{text_of(fault)} {begins}"))
    supervisor.follow(lambda: len(injected) == 2, 10)
    assert injected == ["a-b@0-0.05 True", "a-b@0-0.05 False"]
    assert injection.stop() == ["a-c@60 came too late: the traffic was over"]


def test_a_restarted_process_is_required_once_it_is_ready(run: Run) -> None:
    supervisor, back = Supervisor(), list[str]()
    with LabProcess(run, "again", [sys.executable, "-c", HEAD + "say(event='ready'); sys.exit('no more')"]) as again:
        supervisor.expect(again, lambda event: back.append(event["event"]))
        with pytest.raises(FailedError, match=r"again ended with code 1\n    no more"):
            supervisor.follow(lambda: False, 10)
    assert back == ["ready"]
