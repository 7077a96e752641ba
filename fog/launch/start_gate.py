"""Start gate for a command that waits for a cluster: ``python -m fog.launch.start_gate GATE -- COMMAND ...``.

I/O. The gate is a file that the launch keeps locked until the cluster serves. The kernel releases the lock with its
process, so no command waits for a launch that was killed.
"""

from __future__ import annotations

import fcntl
import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_SERVING: Final = "serving"


@dataclass(slots=True)
class StartGate:
    """Gate, held by the launch that makes other processes wait.

    Args:
        descriptor: descriptor of the locked file; -1 after the gate was opened.
    """

    path: Path
    descriptor: int

    @classmethod
    def closed(cls, path: Path) -> StartGate:
        """Create a closed gate."""
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        return cls(path, descriptor)

    def prefix(self) -> list[str]:
        """Return the command-line prefix for a process that waits."""
        return [sys.executable, "-m", "fog.launch.start_gate", str(self.path), "--"]

    def open(self, *, serving: bool) -> None:
        """Let waiting processes start, or make them exit if the cluster does not serve. Only the first call counts."""
        if self.descriptor < 0:
            return
        if serving:
            os.write(self.descriptor, _SERVING.encode())
        os.close(self.descriptor)
        self.descriptor = -1


def main() -> None:
    """Wait, then replace this process with the command; exit with status 1 if the cluster does not serve."""
    path, separator, *command = sys.argv[1:] if len(sys.argv) > 3 else ("", "")
    if separator != "--":
        sys.exit("expected: GATE -- COMMAND [ARGUMENT ...]")
    signal.signal(signal.SIGINT, lambda *_: sys.exit(0))  # the launch ends before the command was started
    try:
        with open(path, encoding="utf-8") as gate:
            fcntl.flock(gate, fcntl.LOCK_SH)
            is_serving = gate.read() == _SERVING
    except FileNotFoundError:
        is_serving = False
    if not is_serving:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the launch sends SIGINT at the same time
        sys.exit("not started: the cluster does not serve")
    os.execvp(command[0], command)


if __name__ == "__main__":
    main()
