"""LabMachine with a real switch, a RIB and nodes for the library, in a namespace of its own."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from gdp.crypto.certificates import Role
from gdp.host.run_registry import Run
from lab.credentials import NameRights, make_nodes
from lab.machine import LabMachine
from lab.namespaces import Namespaces
from lab.process import LabProcess, new_run
from lab.topology import single
from tests.pages import ROOT

PATIENCE_S: Final = 30.0
EXAMPLES: Final[Path] = ROOT / "examples"
_MACHINE: Final = "lab"
Rights = Mapping[str, NameRights]  # by node


class SessionLab(LabMachine):
    """Running processes. ``folder / label`` is the directory of a node; its device is the label and a 0."""

    def __init__(self, run: Run, rights: Rights, types: Mapping[str, str]) -> None:
        enter = Namespaces(single(_MACHINE), run)[_MACHINE].command([])
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        super().__init__(run.directory, enter, run=run, environment={"PATH": path, "PYTHONUNBUFFERED": "1"})
        if rights:
            self._make_nodes(rights, types)

    def python(self, *argv: str) -> LabProcess:
        """Start Python with these arguments."""
        return self.launch([sys.executable, *argv])

    def _make_nodes(self, rights: Rights, types: Mapping[str, str]) -> None:
        nodes = {"switch": Role.SWITCH, "rib": Role.RIB, **dict.fromkeys(rights, Role.PROXY)}
        make_nodes(self.folder, nodes, rights, types)
        attach = ["rib0", *(f"{label}0" for label in rights)]
        self.write("switch", "switch", attach=attach, data_plane="raw")
        self.write("rib", "rib", iface="rib0")
        self.start("switch", "switch")
        self.start("rib", "rib")


@contextmanager
def session_lab(rights: Rights, types: Mapping[str, str] | None = None) -> Iterator[SessionLab]:
    """Run a lab whose nodes have these rights, without rights only an empty machine; end it on leaving.

    ``types``: ROS types of names.
    """
    with new_run() as run, SessionLab(run, rights, types or {}) as lab:
        yield lab


def execute(code: str) -> None:
    """Run a program that a test writes; a process of its own."""
    exec(compile(code, "program", "exec"), {"__name__": "__main__"})


def lines_of(process: LabProcess, count: int) -> Sequence[str]:
    """Return the next lines that a process prints."""
    return [process.read_line(PATIENCE_S).decode().strip() for _ in range(count)]
