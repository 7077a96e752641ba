"""Machine with a real switch, a RIB and nodes for the library, in a namespace of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

import yaml

from gdp.crypto.certificates import Role
from gdp.host.processes import Process, end_all
from gdp.host.run_registry import Run, RunRegistry
from gdp.stores.issue import make_domain, make_node, make_owner
from gdp.stores.keyring import ROOT_CERTIFICATE
from gdp.trust.right import Right
from lab.credentials import grant
from lab.namespaces import Namespaces
from lab.process import LabProcess
from lab.topology import DomainPlan, Topology
from tests.pages import ROOT

PATIENCE_S: Final = 30.0
_MACHINE: Final = "lab"
Rights = Mapping[str, Mapping[str, Collection[Right]]]  # by node and name


class SessionLab:
    """Running processes. ``folder / label`` is the directory of a node; its device is the label and a 0."""

    def __init__(self, run: Run, undo: ExitStack, rights: Rights, types: Mapping[str, str]) -> None:
        self.folder = run.directory
        self._run = run
        self._undo = undo
        self._spaces = Namespaces(Topology((), (DomainPlan(_MACHINE, (_MACHINE,)),), ()), run)
        if rights:
            self._make_nodes(rights, types)

    def _make_nodes(self, rights: Rights, types: Mapping[str, str]) -> None:
        make_domain(self.folder / "domain", _MACHINE)
        make_owner(self.folder / "owner")
        attach = ["rib0", *(f"{label}0" for label in rights)]
        self._start_node(Role.SWITCH, {"attach": attach, "data_plane": "raw"})
        self._start_node(Role.RIB, {"iface": "rib0"})
        for label, names in rights.items():
            node = self.folder / label
            make_node(node, Role.PROXY, label, self.folder / "domain")
            (node / "delegations").mkdir(exist_ok=True)
            grant(self.folder / "owner", node, names, types)

    def start(self, *argv: str) -> subprocess.Popen[str]:
        """Start Python with these arguments on the machine; it ends with the lab."""
        return self.start_command([sys.executable, *argv])

    def start_command(self, argv: Sequence[str]) -> subprocess.Popen[str]:
        """Start a command on the machine; it ends with the lab."""
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", "PATH": path}
        process = subprocess.Popen(
            self._spaces[_MACHINE].command(argv),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=self.folder,
            env=environment,
            start_new_session=True,
        )
        self._run.note_process(process.pid)
        self._undo.callback(_end, process)
        return process

    def output(self, process: subprocess.Popen[str]) -> str:
        """Return the output of a process that ends by itself."""
        out, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 0, f"exit {process.returncode}: {out}{errors}"
        return out

    def _start_node(self, role: Role, content: Mapping[str, object]) -> None:
        identity = self.folder / role.value
        make_node(identity, role, role.value, self.folder / "domain")
        path = self.folder / f"{role.value}.yaml"
        root = str(self.folder / "domain" / ROOT_CERTIFICATE)
        path.write_text(yaml.safe_dump({"identity": str(identity), "domain": {"root": root}, **content}))
        argv = [sys.executable, "-m", f"gdp.cli.{role.value}", "--json", "--config", str(path)]
        process = LabProcess(self._run, role.value, self._spaces[_MACHINE].command(argv))
        self._undo.callback(process.close)
        assert process.read(PATIENCE_S)["event"] == "ready"


def _end(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        end_all([Process.from_pid(process.pid)])
    process.communicate()


@contextmanager
def session_lab(rights: Rights, types: Mapping[str, str] | None = None) -> Iterator[SessionLab]:
    """Run a lab whose nodes have these rights, without rights only an empty machine; end it on leaving.

    ``types``: ROS types of names.
    """
    run = RunRegistry().start()
    with ExitStack() as undo:
        undo.callback(run.end)
        yield SessionLab(run, undo, rights, types or {})


def lines_of(process: subprocess.Popen[str], count: int) -> Sequence[str]:
    """Return the next lines that a process prints."""
    assert process.stdout is not None
    return [process.stdout.readline().strip() for _ in range(count)]


EXAMPLES: Final[Path] = ROOT / "examples"
