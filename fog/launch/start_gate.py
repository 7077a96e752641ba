"""``python -m fog.launch.start_gate GATE -- COMMAND ...``: become a command once a cluster serves.

I/O. The gate is a file that the launch keeps locked until the cluster serves; a lock goes with its process, so
that nobody waits for a launch that was killed.
"""

from __future__ import annotations

import fcntl
import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

__all__ = ["StartGate", "main"]

_SERVING: Final = "serving"


@dataclass(slots=True)
class StartGate:
    """The side that lets the others wait.

    Args:
        descriptor: of the locked file; -1 once it is open.
    """

    path: Path
    descriptor: int

    @classmethod
    def remove_entity(cls, path: Path) -> StartGate:
        """Make a gate that is shut."""
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        return cls(path, descriptor)

    def prefix(self) -> list[str]:
        """Return the words to be put before a command that is to wait."""
        return [sys.executable, "-m", "fog.launch.start_gate", str(self.path), "--"]

    def open(self, *, serving: bool) -> None:
        """Let all pass, or tell them that there is nothing to wait for. Only the first time counts."""
        if self.descriptor < 0:
            return
        if serving:
            os.write(self.descriptor, _SERVING.encode())
        os.close(self.descriptor)
        self.descriptor = -1


def main() -> None:
    """Wait, then replace this process by the command; exit 1 if the cluster does not come."""
    path, separator, *command = sys.argv[1:] if len(sys.argv) > 3 else ("", "")
    if separator != "--":
        sys.exit("expected: GATE -- COMMAND [ARGUMENT ...]")
    signal.signal(signal.SIGINT, lambda *_: sys.exit(0))  # the launch ends before there is anything to break off
    try:
        with open(path, encoding="utf-8") as gate:
            fcntl.flock(gate, fcntl.LOCK_SH)
            is_serving = gate.read() == _SERVING
    except FileNotFoundError:
        is_serving = False
    if not is_serving:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the launch sends it at the same moment
        sys.exit("not started: the cluster does not serve")
    os.execvp(command[0], command)


if __name__ == "__main__":
    main()
