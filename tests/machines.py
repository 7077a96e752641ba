"""Two machines of the pages, as two folders in which their commands run; ``scp`` between them copies."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.pages import ROOT, Block
from tests.script_packages import PYTHON_PATH

_COPY = """#!{python}
import subprocess, sys
*given, last = [word for word in sys.argv[1:] if not word.startswith("-")]
sys.exit(subprocess.call(["cp", "-rp", *given, {folder!r} + "/" + last.replace(".local:", "/")]))
"""


class Machines:
    """Robot and server.

    Attributes:
        done: the command lines that were run, in order.
    """

    def __init__(self, folder: Path) -> None:
        self.robot, self.server = folder / "robot" / "gdp", folder / "server" / "gdp"
        self.done: list[str] = []
        for home in (self.robot, self.server):
            home.mkdir(parents=True)
            (home / "scripts").symlink_to(ROOT / "scripts")
        programs = folder / "bin"
        programs.mkdir()
        (programs / "scp").write_text(_COPY.format(python=sys.executable, folder=str(folder)))
        (programs / "scp").chmod(0o755)
        path = os.pathsep.join([str(programs), str(Path(sys.executable).parent), os.environ["PATH"]])
        self.environment = {**os.environ, "PATH": path, "PYTHONPATH": PYTHON_PATH}

    def home_of(self, block: Block) -> Path:
        """Return the folder of the machine that a block is about."""
        return {"on the robot": self.robot, "on the server": self.server}[block.title]

    def write(self, block: Block) -> None:
        """Write a configuration file of the robot."""
        (self.robot / block.title).write_text(block.text)

    def run(self, line: str, home: Path) -> str:
        """Run one command line to its end; return its output."""
        done = subprocess.run(
            ["bash", "-ec", line], cwd=home, env=self.environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{line}\n{done.stderr}"
        self.done.append(line)
        return done.stdout
