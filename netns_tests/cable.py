"""Cable ``eth0`` between two machines, and the terminals in which the commands of a page run there."""

from __future__ import annotations

import contextlib
import selectors
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

from lab.namespaces import wait_for_carrier
from netns_tests.spaces import Space
from tests.machines import Machines

_PATIENCE_S = 60.0
_READY = (" is up", " is attached", "started core service")


class Terminals:
    """Long-running commands, each in a terminal of its own."""

    def __init__(self, machines: Machines, into_server: list[str]) -> None:
        self._machines = machines
        self._into_server = into_server
        self._running: list[tuple[str, subprocess.Popen[bytes]]] = []

    def words(self, home: Path) -> list[str]:
        """Return a function that runs a command on the machine with this folder."""
        return self._into_server if home == self._machines.server else []

    def start(self, line: str, home: Path) -> None:
        """Start a command and return when it reports that it is ready."""
        process = subprocess.Popen(
            [*self.words(home), "bash", "-c", f"exec {line.removesuffix('&')}"],
            cwd=home,
            env=self._machines.environment,
            stdout=subprocess.PIPE,
            bufsize=0,
        )
        self._running.append((line, process))
        heard = [_line_of(process)]
        while heard[-1] and not any(word in heard[-1] for word in _READY):
            heard.append(_line_of(process))
        assert heard[-1], f"{line}: ended after {heard}"

    def signal(self, part: str, number: signal.Signals) -> None:
        """Send a signal to the only command whose line contains this text."""
        (process,) = (process for line, process in self._running if part in line)
        process.send_signal(number)

    def end(self, part: str = "") -> dict[str, str]:
        """Press Ctrl-C in each command with ``part`` in its line, last started first; return the output by program."""
        said = {}
        for line, process in reversed([each for each in self._running if part in each[0]]):
            self._running.remove((line, process))
            process.send_signal(signal.SIGINT)
            rest, _ = process.communicate(timeout=_PATIENCE_S)
            said[f"{line.split()[0]}, exit {process.returncode}"] = rest.decode()
        return said

    def close(self) -> None:
        """End all running commands, with a signal first: roscore has children of its own."""
        while self._running:
            _, process = self._running.pop()
            process.send_signal(signal.SIGINT)
            try:
                process.communicate(timeout=_PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


def _line_of(process: subprocess.Popen[bytes]) -> str:
    assert process.stdout is not None
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        assert selector.select(_PATIENCE_S), "nothing said"
    return process.stdout.readline().decode()  # byte by byte, so that select sees what remains


@contextlib.contextmanager
def sim_link(space: Space) -> Iterator[list[str]]:
    """Join this namespace to another by ``eth0``; yield the words that run a command in the other one."""
    with Space() as other:
        other.ip("set", "lo", "up")
        anchor = subprocess.Popen(["cat"], stdin=subprocess.PIPE)
    try:
        space.ip("set", "lo", "up")
        space.ip("add", "eth0", "type", "veth", "peer", "name", "eth0", "netns", str(anchor.pid))
        enter = ["nsenter", f"--net=/proc/{anchor.pid}/ns/net"]
        subprocess.run([*enter, "ip", "link", "set", "eth0", "up"], check=True)
        space.ip("set", "eth0", "up")
        wait_for_carrier("eth0")
        yield enter
    finally:
        anchor.communicate()
