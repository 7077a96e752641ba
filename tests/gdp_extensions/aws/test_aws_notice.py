"""Watcher of an EC2 machine, against a metadata service on a loopback port."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from fog.host.bundle import install
from fog.host.preemption_notice import read_notice
from fog.machine import MachineBundle
from gdp.intervals import DRAIN_S
from gdp_extensions.aws.notice import Metadata, Watch
from gdp_extensions.aws.provider import WATCHER

ACTION = "/latest/meta-data/spot/instance-action"
DRAIN = "/latest/meta-data/tags/instance/fog-drain"
LEAVES_AT = 1_505_722_920.0  # 2017-09-18T08:22:00Z
MACHINE = """
import json, signal, subprocess, sys
watched = {signal.SIGUSR1, signal.SIGUSR2}
signal.pthread_sigmask(signal.SIG_BLOCK, watched)  # before there is any other thread, which might take one
program = subprocess.Popen(sys.argv[1:], stdout=subprocess.PIPE, text=True)
signals = sorted(signal.Signals(signal.sigwait(watched)).name for _ in watched)
program.terminate()
words, _ = program.communicate()
print(json.dumps({"signals": signals, "exit": program.returncode, "printed": words.splitlines()}))
"""


class Service(ThreadingHTTPServer):
    """Version 2 of the service: a path's text, for clients with a token."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Answer)
        self.reported: dict[str, str] = {}
        self.token = "first"
        self.tokens_given = 0

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class Answer(BaseHTTPRequestHandler):
    server: Service

    def do_PUT(self) -> None:
        is_right = self.path == "/latest/api/token" and int(self.headers["X-aws-ec2-metadata-token-ttl-seconds"]) > 0
        self.server.tokens_given += 1
        self.reply(200 if is_right else 400, self.server.token)

    def do_GET(self) -> None:
        if self.headers["X-aws-ec2-metadata-token"] != self.server.token:
            self.reply(401, "")
        elif self.path in self.server.reported:
            self.reply(200, self.server.reported[self.path])
        else:
            self.reply(404, "")

    def reply(self, code: int, text: str) -> None:
        self.send_response(code)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text.encode())

    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture
def service() -> Iterator[Service]:
    with Service() as made:
        thread = threading.Thread(target=made.serve_forever, args=(0.01,))
        thread.start()
        yield made
        made.shutdown()
        thread.join()


class Seen:
    """Watch and its reports."""

    def __init__(self, service: Service) -> None:
        self.notices: list[float] = []
        self.drains = 0
        self.watch = Watch(Metadata(service.url), self.notices.append, self.drain)

    def drain(self) -> None:
        self.drains += 1


def interrupt(service: Service) -> None:
    service.reported[ACTION] = json.dumps({"action": "terminate", "time": "2017-09-18T08:22:00Z"})


def test_a_machine_that_may_stay_hears_nothing(service: Service) -> None:
    seen = Seen(service)
    assert not seen.watch.poll(LEAVES_AT)
    assert (seen.notices, seen.drains, service.tokens_given) == ([], 0, 1)


def test_a_notice_is_reported_at_once_and_the_machine_drains_in_time(service: Service) -> None:
    seen = Seen(service)
    interrupt(service)
    assert not seen.watch.poll(LEAVES_AT - 120)
    assert not seen.watch.poll(LEAVES_AT - 90)
    assert (seen.notices, seen.drains) == ([LEAVES_AT], 0)
    assert seen.watch.poll(LEAVES_AT - DRAIN_S)
    assert (seen.notices, seen.drains) == ([LEAVES_AT], 1)


def test_the_owners_tag_drains_at_once(service: Service) -> None:
    seen = Seen(service)
    service.reported[DRAIN] = "1"
    assert seen.watch.poll(0.0)
    assert (seen.notices, seen.drains) == ([], 1)


def test_an_expired_token_is_replaced(service: Service) -> None:
    seen = Seen(service)
    seen.watch.poll(0.0)
    service.token = "second"
    interrupt(service)
    seen.watch.poll(0.0)
    assert seen.notices == [LEAVES_AT]
    assert service.tokens_given == 2


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"time": 3}', '{"time": "soon"}', "\u00e4"])
def test_nonsense_is_an_error_that_may_pass(service: Service, text: str) -> None:
    seen = Seen(service)
    service.reported[ACTION] = text
    with pytest.raises(OSError, match=r"makes no sense|metadata"):
        seen.watch.poll(0.0)
    interrupt(service)
    seen.watch.poll(0.0)
    assert seen.notices == [LEAVES_AT]


def test_the_program_tells_the_machine_and_waits_to_be_ended(service: Service, tmp_path: Path) -> None:
    interrupt(service)
    program = [sys.executable, "-m", "gdp_extensions.aws.notice", "--home", str(tmp_path), "--url", service.url]
    machine = [sys.executable, "-c", MACHINE, *program, "--poll-s", "0.01"]
    done = subprocess.run(machine, capture_output=True, text=True, timeout=60, check=True)
    assert json.loads(done.stdout) == {
        "signals": ["SIGUSR1", "SIGUSR2"],  # the moment is long past
        "exit": 0,
        "printed": ["EC2 takes this machine at 1505722920", "the machine drains"],
    }
    assert read_notice(tmp_path) == LEAVES_AT


def test_a_machine_ends_well_when_its_owner_drains_it(service: Service, tmp_path: Path) -> None:
    service.reported[DRAIN] = "1"
    home = tmp_path / "machine"
    watcher = replace(WATCHER, argv=(*WATCHER.argv, "--url", service.url, "--poll-s", "0.01"))
    install(home, MachineBundle({}, (watcher,)))
    command = [sys.executable, "-m", "fog.host.cli", "--home", str(home), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert json.loads(done.stdout)["reason"] == "drained"
