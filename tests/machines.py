"""Two machines of the pages, as two folders in which their commands run; ``scp`` between them copies."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from lab.machine import LabMachine
from lab.namespaces import Namespace
from lab.process import LabProcess
from tests.pages import ROOT, Block

_COPY = """#!{python}
import subprocess, sys
*given, last = [word for word in sys.argv[1:] if not word.startswith("-")]
sys.exit(subprocess.call(["cp", "-rp", *given, {folder!r} + "/" + last.replace(".local:", "/")]))
"""
_SPECIAL = frozenset("$`\\*?[]{}()<>|&;~#!'\"\n")  # of the shell
_PATIENCE_S = 60.0
_READY = (" is up", " is attached", "started core service")
NODES = ("gdp-switch ", "gdp-rib ", "gdp-proxy ", "roscore")


class Machines:
    """Robot and server; a context manager that ends what they run.

    Args:
        server: namespace of the server; by default both are in the present one.

    Attributes:
        hosts: the machines by folder.
        done: the command lines that were run, in order.
        running: the command lines that run, each in a terminal of its own, and their processes.
    """

    def __init__(self, folder: Path, server: Namespace | None = None) -> None:
        self.robot, self.server = folder / "robot" / "gdp", folder / "server" / "gdp"
        self.done: list[str] = []
        self.running: list[tuple[str, LabProcess]] = []
        for home in (self.robot, self.server):
            home.mkdir(parents=True)
            (home / "scripts").symlink_to(ROOT / "scripts")
        programs = folder / "bin"
        programs.mkdir()
        (programs / "scp").write_text(_COPY.format(python=sys.executable, folder=str(folder)))
        (programs / "scp").chmod(0o755)
        path = os.pathsep.join([str(programs), str(Path(sys.executable).parent), os.environ["PATH"]])
        into_server = [] if server is None else server.command([])
        self.hosts = {
            home: LabMachine(home, enter, environment={"PATH": path})
            for home, enter in ((self.robot, []), (self.server, into_server))
        }

    def __enter__(self) -> Machines:
        return self

    def __exit__(self, *_error: object) -> None:
        for _, process in self.running:
            process.send(signal.SIGINT)  # roscore ends its children
        for host in self.hosts.values():
            host.close()

    def home_of(self, block: Block) -> Path:
        """Return the folder of the machine that a block is about."""
        return {"on the robot": self.robot, "on the server": self.server}[block.title.partition(",")[0]]

    def write(self, block: Block) -> None:
        """Write a configuration file of the robot."""
        (self.robot / block.title).write_text(block.text)

    def run(self, line: str, home: Path) -> str:
        """Run one command line to its end; return its output."""
        self.done.append(line)
        words = line.split()
        program = Path(sys.executable).parent / words[0]
        is_plain = _SPECIAL.isdisjoint(line) and program.exists()  # the shell would start it with the same words
        return self.hosts[home].output(*([str(program), *words[1:]] if is_plain else ["bash", "-ec", line]))

    def start(self, line: str, home: Path) -> None:
        """Start a command; return when it reports that it is ready. Its log is in its folder."""
        process = self.hosts[home].launch(["bash", "-c", f"exec {line.removesuffix('&')}"], line.split(maxsplit=1)[0])
        self.running.append((line, process))
        process.read_until(*_READY, patience_s=_PATIENCE_S)

    def follow(self, blocks: Iterable[Block], *, but: Sequence[str] = ()) -> str:
        """Do what these blocks of a page tell, without lines that begin with one of ``but``; return the output."""
        printed = ""
        for block in blocks:
            if block.language == "yaml":
                self.write(block)
            elif block.title:
                for line in block.lines:
                    if line.startswith(tuple(but)):
                        continue
                    if line.startswith(NODES) and "--check" not in line:
                        self.start(line, self.home_of(block))
                    else:
                        printed += self.run(line, self.home_of(block))
        return printed

    def end(self, part: str = "", number: signal.Signals = signal.SIGINT) -> dict[str, str]:
        """Press Ctrl-C in each command with ``part`` in its line, last started first; return the output by program."""
        said = {}
        for line, process in reversed([each for each in self.running if part in each[0]]):
            self.running.remove((line, process))
            rest = process.finish(number, _PATIENCE_S)
            said[f"{line.split()[0]}, exit {process.code}"] = rest
        return said
