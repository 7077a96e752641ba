"""Process of a bench in a namespace of its own, controlled by JSON lines; and the reader and writer in that process.

I/O. The kernel kills it with the thread that started it, so that no worker outlives a bench, however that ends.

"""

from __future__ import annotations

import json
import select
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.simulation.namespaces import Namespaces

__all__ = ["Answer", "Worker", "answer", "command", "command_waits", "floats", "integer", "number"]

Value = str | int | float | bool | None | list[str] | list[int] | list[float] | dict[str, str] | dict[str, int]
Answer = dict[str, Value]
_PATIENCE_S: Final = 5.0


class Worker:
    """Running role of ``roles.py``; a context manager that ends it.

    Args:
        spaces: the namespaces.
        node: the namespace of the worker.
        role: its role.
        cpu: the core to run on; None leaves that to the scheduler.
        settings: settings of the role at its start.

    Raises:
        LocalError: it ended before it was ready; ``refused`` in its only line gives the reason, or stderr does.
    """

    roles = Path(__file__).with_name("roles.py")  # another commit's packages while those are measured

    def __init__(self, spaces: Namespaces, node: str, role: str, *, cpu: int | None = None, **settings: Value) -> None:
        roles = Worker.roles
        reported = json.dumps({"role": role, "cpu": cpu, **settings})
        self._role = role
        self._process = subprocess.Popen(
            spaces.command(node, [sys.executable, str(roles), reported]),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C is for the bench alone, which then ends them in order
        )

    @property
    def pid(self) -> int:
        """Process id of the worker."""
        return self._process.pid

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # it ended before
            self._process.stdin.close()
        try:
            self._process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def read(self) -> Answer:
        """Return its next line.

        Raises:
            LocalError: it ended, or could not do the command.
        """
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise LocalError(f"the {self._role} of the bench ended early; see above")
        said: Answer = json.loads(line)
        if "refused_because" in said:
            raise LocalError(str(said["refused_because"]))
        return said

    def tell(self, **values: Value) -> None:
        """Send a command, without waiting for an answer."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(values) + "\n")
        self._process.stdin.flush()

    def ask(self, **values: Value) -> Answer:
        """Send a command and return the answer.

        Raises:
            LocalError: as ``read``.
        """
        self.tell(**values)
        return self.read()


def number(value: Value) -> float:
    """Return a figure of an answer.

    Raises:
        LocalError: it is none.
    """
    if not isinstance(value, int | float):
        raise LocalError(f"a figure was expected, not {value!r}")
    return value


def integer(value: Value) -> int:
    """Return a count of an answer; raises as ``number``."""
    return int(number(value))


def floats(value: Value) -> list[float]:
    """Return a list of figures of an answer; raises as ``number``."""
    if not isinstance(value, list):
        raise LocalError(f"figures were expected, not {value!r}")
    return [number(each) for each in value]


def answer(values: Mapping[str, Value]) -> None:
    """Send an answer to the bench."""
    print(json.dumps(values), flush=True)


def command() -> Answer:
    """Wait for the next command; the process ends with its bench."""
    line = sys.stdin.readline()
    if not line:
        sys.exit(0)
    said: Answer = json.loads(line)
    return said


def command_waits() -> bool:
    """Return whether ``command`` would return at once. One line is requested at a time, so none is in a buffer."""
    return bool(select.select([sys.stdin], [], [], 0)[0])
