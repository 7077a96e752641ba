"""Fresh machine of a laboratory: a host with files of its own, on which a person types commands in root shells.

I/O; needs root. A mount namespace hides the places where commands write (``HIDDEN``), so nothing is there before and
nothing stays. Each command runs in a shell of its own, as in several terminals.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from lab.internet.host import Host
from lab.machine import LabMachine
from lab.process import ROOT, LabProcess

HIDDEN: Final = ("/var/lib", "/run", "/dev/shm")
_HOME: Final = "/run/root"
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


class FreshMachine(LabMachine):
    """A machine with empty folders; a context manager that ends its commands.

    ``host``: of a laboratory. Raises ``FailedError``: the kernel refuses the mounts.
    """

    def __init__(self, host: Host, folder: Path) -> None:
        self.host = host
        mounts = " && ".join(f"mount -t tmpfs -o mode=755 tmpfs {each}" for each in HIDDEN)
        script = f"{mounts} && mkdir {_HOME} && echo mounted && exec sleep infinity"
        argv = ["unshare", "--mount", "--propagation", "private", "--", "sh", "-c", script]
        holder = host.launch(argv, f"{host.label}-mounts")
        holder.read_until("mounted")
        entered = ["nsenter", f"--mount=/proc/{holder.pid}/ns/mnt", "--", "env", f"HOME={_HOME}"]
        super().__init__(folder, host.command(entered))

    def type(self, command: str, answer: str = "") -> LabProcess:
        """Start a command as a person types it in a root shell, in which the environment of Python is active.

        Args:
            answer: what the command gets when it asks; empty: nothing.
        """
        path = f"{Path(sys.executable).parent}:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
        environment = ["LANG=C.UTF-8", f"PATH={path}", f"PYTHONPATH={ROOT}", f"HOME={_HOME}"]
        argv = ["env", "-i", *environment, "bash", "-c", f"exec {command}"]
        typed = self.launch(argv, f"{self.host.label}-{len(self.running)}", heard=False, has_orders=bool(answer))
        return typed.answer(answer) if answer else typed
