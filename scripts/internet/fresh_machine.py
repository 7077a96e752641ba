"""Fresh machine of a laboratory: a host with files of its own, on which a person types commands in root shells.

I/O; needs root. A mount namespace hides the places where commands write (``HIDDEN``), so nothing is there before and
nothing stays. Each command runs in a shell of its own, as in several terminals.
"""

from __future__ import annotations

import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from internet.host import Host
from lab.process import LabProcess

HIDDEN: Final = ("/var/lib", "/run", "/dev/shm")
_HOME: Final = "/run/root"
_ROOT: Final = Path(__file__).resolve().parents[2]
_END_S: Final = 20.0
_LOOK_S: Final = 0.02
_SHOWN: Final = 3_000  # characters of a log
_INTERRUPTIBLE: Final = ("env", "--default-signal=INT")  # a background job of a shell script ignores the signal
_BLOCK: Final = re.compile(r"^```\w*\n# on the ([\w-]+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True, slots=True)
class TypedCommand:
    """A command, and the machine on which a person types it."""

    machine: str
    text: str


def typed_commands(page: str) -> list[TypedCommand]:
    """Return the commands that a page tells a person to type: the lines of blocks that begin ``# on the MACHINE``."""
    blocks = [(found[1], found[2].splitlines()) for found in _BLOCK.finditer(page)]
    return [
        TypedCommand(machine, line.partition("  # ")[0].strip())
        for machine, lines in blocks
        for line in lines
        if line and not line.startswith("#")
    ]


class Shell(LabProcess):
    """A command that runs in a shell on a machine."""

    def __init__(self, argv: Sequence[str], log: Path) -> None:
        super().__init__(None, log.stem, [*_INTERRUPTIBLE, *argv], log=log, heard=False)

    @property
    def text(self) -> str:
        """Return what it has printed."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def exit_code(self, timeout_s: float) -> int:
        """Return the exit code of the command. Raises ``LocalError``: it goes on after this time."""
        try:
            self.reap(timeout_s)
        except subprocess.TimeoutExpired as error:
            raise LocalError(f"goes on after {timeout_s:g} s: {self.text[-_SHOWN:]}") from error
        return self.code or 0

    def wait(self, timeout_s: float) -> None:
        """Return when the command has ended well. Raises ``LocalError``: it failed, or goes on."""
        if code := self.exit_code(timeout_s):
            raise LocalError(f"exit code {code}: {self.text[-_SHOWN:]}")

    def wait_for(self, words: str, timeout_s: float) -> None:
        """Return when the command has printed some words. Raises ``LocalError``: it has ended, or does not."""
        end_s = time.monotonic() + timeout_s
        while words not in self.text:
            if self.code is not None or time.monotonic() > end_s:
                raise LocalError(f"did not print {words!r}: {self.text[-_SHOWN:]}")
            time.sleep(_LOOK_S)

    def end(self) -> None:
        """End the command as Ctrl-C does."""
        self.send(signal.SIGINT)
        try:
            self.reap(_END_S)
        except subprocess.TimeoutExpired:
            self.kill_group()


class FreshMachine:
    """A machine with empty folders; a context manager that ends its commands.

    ``host``: of a laboratory. Raises ``LocalError``: the kernel refuses the mounts.
    """

    def __init__(self, host: Host, folder: Path) -> None:
        self.host = host
        self._folder = folder
        self._shells: list[Shell] = []
        mounts = " && ".join(f"mount -t tmpfs -o mode=755 tmpfs {each}" for each in HIDDEN)
        script = f"{mounts} && mkdir {_HOME} && echo mounted && exec sleep infinity"
        argv = host.command(["unshare", "--mount", "--propagation", "private", "--", "sh", "-c", script])
        self._holder = Shell(argv, folder / f"{host.label}-mounts.log")
        self._holder.wait_for("mounted", _END_S)

    def __enter__(self) -> FreshMachine:
        return self

    def __exit__(self, *_: object) -> None:
        for shell in (*reversed(self._shells), self._holder):
            shell.end()

    def command(self, argv: Sequence[str]) -> list[str]:
        """Return the command line that runs ``argv`` on the machine, with its files and environment."""
        entered = ["nsenter", f"--mount=/proc/{self._holder.pid}/ns/mnt", "--", "env", f"HOME={_HOME}", *argv]
        return self.host.command(entered)

    def type(self, command: str, answer: str = "") -> Shell:
        """Start a command as a person types it in a root shell, in which the environment of Python is active.

        Args:
            answer: what the command gets when it asks; empty: it has the input of this program.
        """
        answered = f" <<< {shlex.quote(answer)}" if answer else ""
        path = f"{Path(sys.executable).parent}:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
        environment = ["LANG=C.UTF-8", f"PATH={path}", f"PYTHONPATH={_ROOT}", f"HOME={_HOME}"]
        log = self._folder / f"{self.host.label}-{len(self._shells)}.log"
        shell = Shell(self.command(["env", "-i", *environment, "bash", "-c", f"exec {command}{answered}"]), log)
        self._shells.append(shell)
        return shell
