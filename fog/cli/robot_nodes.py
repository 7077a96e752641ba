"""Robot's nodes of a launch file: they start on the robot's host and end with the command."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

from fog.child_environment import child_environment
from fog.launch.resolve import PYTHON, command_line
from gdp.errors import LocalError
from gdp.intervals import STOP_S, UPKEEP_S
from gdp.terminal import echo

if TYPE_CHECKING:
    from fog.cluster import RobotNode

INTERRUPTED: Final = 130  # exit code after Ctrl-C

Started: TypeAlias = "tuple[RobotNode, tuple[str, ...]]"


def resolved(each: RobotNode) -> Started:
    """Return a node with its command line."""
    words = command_line(each.node, os.environ)
    return each, tuple(sys.executable if word == PYTHON else word for word in words)


def run(nodes: Sequence[Started], logs: Path, check: Callable[[], None] = lambda: None) -> int:
    """Run nodes until all have ended, or Ctrl-C ends them; return the highest exit code.

    Args:
        logs: folder for the output of nodes that do not print to the terminal. Their errors appear in the terminal, as
            with ``ros2 launch``.
        check: called about once a second; what it raises ends the nodes.
    """
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for index, (each, words) in enumerate(nodes):
            processes.append(_start(each, words, logs / f"{index}-{each.node.executable.rpartition('/')[2]}.log"))
        while not _await(processes, UPKEEP_S):  # the journal of clusters has no change notification
            check()
        return max((abs(process.returncode) for process in processes), default=0)
    except KeyboardInterrupt:
        return INTERRUPTED
    except OSError as error:
        raise LocalError(f"{error.filename}: {error.strerror}") from error
    finally:
        _end(processes)


def _start(each: RobotNode, words: Sequence[str], path: Path) -> subprocess.Popen[bytes]:
    environment = {**child_environment(os.environ, has_desktop=True), **each.node.environment}
    if each.output in ("screen", "both"):
        return subprocess.Popen(words, env=environment)
    path.parent.mkdir(mode=0o700, exist_ok=True)
    echo(f"{each.node.executable} prints to {path}", err=True)
    with path.open("wb") as file:
        return subprocess.Popen(words, env=environment, stdout=file)


def _end(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """Wait for nodes to end, then send SIGINT, then kill them; a further Ctrl-C kills at once."""
    with suppress(KeyboardInterrupt):
        # at a terminal Ctrl-C reaches the nodes as well; a second signal would interrupt their shutdown
        if _await(processes, UPKEEP_S):
            return
        for process in processes:
            process.send_signal(signal.SIGINT)  # no effect on a process that has ended
        _await(processes, STOP_S)
    for process in processes:
        process.kill()
        process.wait()


def _await(processes: Sequence[subprocess.Popen[bytes]], patience_s: float) -> bool:
    """Return whether all have ended; each may take ``patience_s`` seconds."""
    try:
        for process in processes:
            process.wait(patience_s)
    except subprocess.TimeoutExpired:
        return False
    return True
