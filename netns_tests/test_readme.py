"""What the README promises about two machines, done by its own commands in two namespaces that a cable joins."""

from __future__ import annotations

import contextlib
import selectors
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from netns_tests.spaces import Space
from proxy.compare import compare
from tests.machines import Machines
from tests.pages import ROOT, Block, blocks_between

pytestmark = pytest.mark.netns

_PATIENCE_S = 60.0
_READY = (" is up", " is attached")
_TOPIC = "/camera/image"


class Terminals:
    """The commands that run on, each in a terminal of its own."""

    def __init__(self, machines: Machines, into_server: list[str]) -> None:
        self._machines = machines
        self._into_server = into_server
        self._running: list[tuple[str, subprocess.Popen[str]]] = []

    def start(self, line: str, home: Path) -> None:
        """Start a command and return when it says that it is ready."""
        prefix = self._into_server if home == self._machines.server else []
        process = subprocess.Popen(
            [*prefix, "bash", "-c", f"exec {line.removesuffix('&')}"],
            cwd=home,
            env=self._machines.environment,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._running.append((line, process))
        said = _line_of(process)
        assert any(word in said for word in _READY), f"{line}: {said or 'ended'}"

    def end(self) -> dict[str, str]:
        """Press Ctrl-C in each, the last started first; return what they said then, by program."""
        said = {}
        while self._running:
            line, process = self._running.pop()
            process.send_signal(signal.SIGINT)
            said[f"{line.split()[0]}, exit {process.wait(_PATIENCE_S)}"] = process.communicate()[0]
        return said

    def kill(self) -> None:
        """End what still runs."""
        for _, process in self._running:
            process.kill()
            process.communicate()


def _line_of(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        assert selector.select(_PATIENCE_S), "nothing said"
    return process.stdout.readline()


@contextlib.contextmanager
def _cable(space: Space) -> Iterator[list[str]]:
    """Join this namespace with another by ``eth0``; yield what runs a command in the other."""
    with Space():
        anchor = subprocess.Popen(["cat"], stdin=subprocess.PIPE)
    try:
        space.ip("add", "eth0", "type", "veth", "peer", "name", "eth0", "netns", str(anchor.pid))
        enter = ["nsenter", f"--net=/proc/{anchor.pid}/ns/net"]
        subprocess.run([*enter, "ip", "link", "set", "eth0", "up"], check=True)
        space.ip("set", "eth0", "up")
        space.ready("eth0")
        yield enter
    finally:
        anchor.communicate()


def test_a_recording_goes_from_one_machine_to_the_other_by_the_commands_of_the_readme(
    space: Space, tmp_path: Path
) -> None:
    machines = Machines(tmp_path)
    with _cable(space) as into_server:
        terminals = Terminals(machines, into_server)
        try:
            printed = _follow(machines, terminals, blocks_between(ROOT / "README.md", "Two machines of your own"))
            said = terminals.end()
        finally:
            terminals.kill()
    assert "100 messages sent, 100 confirmed" in printed
    assert said.keys() == {f"gdp-{each}, exit 0" for each in ("switch", "rib", "proxy")}
    assert "100 messages received, 0 lost" in said["gdp-proxy, exit 0"]
    result = compare(machines.robot / "drive.mcap", machines.server / "server/received.mcap", exact=False)
    (image,) = (each for each in result if each.topic == _TOPIC)
    assert (image.delivered, image.identical, image.in_order) == (100, True, True)


def _follow(machines: Machines, terminals: Terminals, page: list[Block]) -> str:
    """Do what the page says, in its order; return what was printed."""
    printed = ""
    for block in page:
        if block.language == "yaml":
            machines.write(block)
        elif block.title:
            home = machines.home_of(block)
            for line in block.lines:
                if line.startswith(("gdp-switch", "gdp-rib", "gdp-proxy")):
                    terminals.start(line, home)
                else:
                    printed += machines.run(line, home)
    return printed
