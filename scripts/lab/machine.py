"""Machine of a laboratory: keys and configuration files of nodes in a folder, and the processes started from them.

I/O. ``OverlayCredentials`` writes the files of a whole topology, and ``LabMachine`` starts those, too.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any, Final, Literal

import yaml

from gdp.closing import ClosedOnExit
from gdp.host.run_registry import Run
from gdp.management.control_client import ask_node, find_control_socket
from gdp.state.control_protocol import Command
from gdp.stores.keyring import ROOT_CERTIFICATE
from lab.process import FailedError, LabProcess, end_processes, python_environment

NodeProgram = Literal["switch", "rib", "relay", "proxy"]

GDP: Final = (sys.executable, "-m", "gdp.cli.gdp")
PROGRAMS: Final = {
    "switch": "gdp.cli.switch",
    "rib": "gdp.cli.rib",
    "relay": "gdp.cli.relay",
    "proxy": "proxy.cli.proxy",
}
_READY_S: Final = 60.0
_READY: Final = r'"event": ?"ready"'
_COMMAND_S: Final = 120.0
_ANSWER_S: Final = 60.0
_END_S: Final = 10.0


class LabMachine(ClosedOnExit):
    """A folder of configurations, and the processes that run from them; a context manager that ends these.

    Args:
        folder: every command runs in it.
        enter: words before each command, such as ``namespace.command([])``; none: the namespace of the caller.
        run: records the processes; None: this object alone ends them.
        environment: extends the present one.
    """

    def __init__(
        self,
        folder: Path,
        enter: Sequence[str] = (),
        *,
        run: Run | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.folder = folder
        self.running: list[LabProcess] = []
        self._enter, self._run = list(enter), run
        self.environment = dict(environment or {})
        self._numbers = count()

    def close(self) -> None:
        """End all processes."""
        end_processes(self.running, _END_S)
        self.running.clear()

    def write(self, name: str, identity: str | Path, **keys: object) -> Path:
        """Write ``NAME.yaml`` of the node whose keys are in the folder ``identity``; return the file."""
        path = self.folder / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        domain = {"root": f"{identity}/{ROOT_CERTIFICATE}"}
        path.write_text(yaml.safe_dump({"identity": str(identity), "domain": domain, **keys}), encoding="utf-8")
        return path

    def launch(
        self, argv: Sequence[str], label: str = "", *, heard: bool = True, has_orders: bool = False
    ) -> LabProcess:
        """Start a command; ``label`` names its log, by default the command and a number. See ``LabProcess``."""
        label = label or f"{Path(argv[0]).name}-{next(self._numbers)}"
        process = LabProcess(
            self._run,
            label,
            [*self._enter, *argv],
            environment=self.environment,
            log=self.folder / f"{label}.log",
            folder=self.folder,
            heard=heard,
            has_orders=has_orders,
        )
        self.running.append(process)
        return process

    def launch_node(self, program: NodeProgram, name: str, *words: str, before: Sequence[str] = ()) -> LabProcess:
        """Start a node from ``NAME.yaml``; its events and its log are in ``NAME.log``.

        ``before``: words before its command.
        """
        argv = [*before, sys.executable, "-m", PROGRAMS[program], "--config", str(self.folder / f"{name}.yaml")]
        return self.launch([*argv, "--json", *words], name, heard=False)

    def start(self, program: NodeProgram, name: str, *words: str) -> LabProcess:
        """Start a node as ``launch_node``, and return it when it is ready. Raises ``FailedError``: it is not."""
        return self.ready(self.launch_node(program, name, *words))

    def ready(self, node: LabProcess) -> LabProcess:
        """Return a launched node when it is ready. Raises ``FailedError``: it ended, or is not in time."""
        node.until_logged(_READY, patience_s=_READY_S)
        return node

    def run(self, *argv: str, answer: str = "", patience_s: float = _COMMAND_S) -> subprocess.CompletedProcess[str]:
        """Run a command to its end; it may fail. ``answer``: what it gets when it asks."""
        return subprocess.run(
            [*self._enter, *argv],
            cwd=self.folder,
            env=python_environment(self.environment),
            input=answer,
            capture_output=True,
            text=True,
            timeout=patience_s,
            check=False,
        )

    def output(self, *argv: str, answer: str = "", patience_s: float = _COMMAND_S) -> str:
        """Run a command to its end, and return what it prints. Raises ``FailedError``: it fails."""
        done = self.run(*argv, answer=answer, patience_s=patience_s)
        if done.returncode:
            raise FailedError(f"{' '.join(argv)}: exit {done.returncode}: {done.stdout}{done.stderr}")
        return done.stdout

    def gdp(self, *words: object, answer: str = "") -> str:
        """Run ``gdp`` to its end, and return what it prints. Raises ``FailedError``: it fails."""
        return self.output(*GDP, *map(str, words), answer=answer)

    def status(self, at: str) -> dict[str, Any]:
        """Return the status of a node, by the path of its control socket or of the folder with its keys."""
        path = self.folder / at
        socket = find_control_socket(path) if path.is_dir() else path
        return dict(ask_node(socket, Command.STATUS, _ANSWER_S).result)

    def kill(self, process: LabProcess) -> None:
        """End a process at once, as the kernel does when memory is short."""
        self.running.remove(process)
        process.kill_group()

    def links(self) -> list[dict[str, Any]]:
        """Return the devices as ``ip -j`` describes them."""
        found: list[dict[str, Any]] = json.loads(self.output("ip", "-j", "link", "show"))
        return found


def gdp(*words: object) -> str:
    """Run ``gdp`` for nodes that run already, and return what it prints. Raises ``FailedError``: it fails."""
    return LabMachine(Path()).gdp(*words)
