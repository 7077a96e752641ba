"""Field of the experiments: a robot, two switches, and any number of machines, a namespace each.

I/O. Makes namespaces and keys, and starts the commands that robots and servers run.
::

    robot -- s1 -- gate --+-- m1          switches s1 and gate with the RIB at gate; a proxy at the robot and at
                          +-- m2          every machine; the machines' proxies expose, the robot's imports
                          +-- (x3) -- m3  x: a relay that adds the link's delay

Every namespace has a ROS domain of its own, so nothing but the proxies joins the nodes. The reason for the settings of
Fast DDS is in ``scripts/bench/ros_row.py``.
"""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from bench_path import ROOT

from gdp.host.run_registry import Run
from lab.credentials import Carried, Side
from lab.dds import ros_environment
from lab.machines import DELAY_LINE, BenchNodes, Lab
from lab.process import LabProcess, UndoneOnExit
from lab.topology import Topology, flat_topology

ROBOT: Final = "robot"
READY_S: Final = 40.0
_NEAR, _GATE = "s1", "gate"
_MTU: Final = 1_500
_HERE: Final = ROOT / "scripts" / "experiments"
REPLICA: Final = _HERE / "replica.py"
_DOMAIN: Final = 150  # ROS domain of the robot; those of the machines follow


@dataclass(frozen=True, slots=True)
class Served:
    """Service of the field.

    ``machines``: the machines that expose it. ``expose``: further keys of their rules. ``imports``: further keys of the
    robot's rule.
    """

    name: str
    type_name: str
    machines: tuple[str, ...]
    expose: Mapping[str, object] = field(default_factory=dict)
    imports: Mapping[str, object] = field(default_factory=dict)

    def carried(self, side: Side) -> Carried:
        """Return it as the proxies of one side carry it."""
        further = self.expose if side == "expose" else self.imports
        return Carried(self.name, self.type_name, "service", {"encoding": "cdr", **further})


@dataclass(frozen=True, slots=True)
class Work:
    """Work of a machine's node: a role of ``program`` and its settings."""

    role: str
    settings: Mapping[str, object] = field(default_factory=dict)
    program: Path = REPLICA


class Server:
    """A machine's proxy and node; both can be killed and started again with the same settings."""

    def __init__(self, place: Field, label: str, config: str, work: Work) -> None:
        self.label = label
        self._place = place
        self._config = config
        self._work = work
        self._running: list[LabProcess] = []

    def begin(self) -> None:
        """Start both."""
        orders = {**self._work.settings, "machine": self.label}
        self._running = [
            self._place.process(self.label, "proxy", ["-m", "proxy.cli.proxy", "--config", self._config]),
            self._place.process(self.label, "node", [str(self._work.program), self._work.role, json.dumps(orders)]),
        ]

    def wait(self) -> None:
        """Wait until both are ready. They report it before the robot's proxy knows of them.

        Raises ``FailedError``: one did not come up.
        """
        for each in self._running:
            each.read_line(READY_S)

    def hear(self, patience_s: float) -> dict[str, object]:
        """Return the next line of its node; raises as ``wait``."""
        return self._running[-1].read(patience_s)

    def kill(self) -> None:
        """Kill both at once with SIGKILL, without any notice."""
        self._signal(signal.SIGKILL)
        self.end()

    def freeze(self) -> None:
        """Stop both; data sent to them waits."""
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Continue both."""
        self._signal(signal.SIGCONT)

    def end(self) -> None:
        """End both; harmless where one is gone already."""
        for each in self._running:
            each.close()
        self._running = []

    def _signal(self, number: int) -> None:
        for each in self._running:
            with suppress(ProcessLookupError):
                os.killpg(each.pid, number)


class Field(UndoneOnExit):
    """Field with switches, RIB, proxies and servers running; a context manager that ends them.

    Args:
        run: run that owns the namespaces.
        served: the services; all machines that any of them names exist.
        work: work of every machine's node.
        delays: one-way delay of a machine's link, in seconds.

    Raises:
        LocalError: the kernel refuses.
        FailedError: a process did not come up; also where ROS 2 is not installed.
    """

    def __init__(
        self,
        run: Run,
        served: Sequence[Served],
        work: Mapping[str, Work],
        *,
        delays: Mapping[str, float] | None = None,
    ) -> None:
        self._machines = tuple(work)
        self._relays = {machine: f"x{machine}" for machine in delays or {}}
        self._lab = Lab(run, self._topology())
        with ExitStack() as undo:
            for machine, seconds in (delays or {}).items():
                relay = [*DELAY_LINE, _GATE, machine, str(1e3 * seconds)]
                line = undo.enter_context(self._lab.start(self._relays[machine], "relay", relay, has_orders=True))
                line.answer("go").read_line(READY_S)
            self._nodes = undo.enter_context(BenchNodes(self._lab, (_NEAR, _GATE), plane="auto", ready_s=READY_S))
            self.data_plane = ", ".join(sorted(self._nodes.planes))
            argv = ["-m", "proxy.cli.proxy", "--config", self._admit(ROBOT, served)]
            robot = undo.enter_context(self.process(ROBOT, "proxy", argv))
            self.servers = {each: Server(self, each, self._admit(each, served), work[each]) for each in self._machines}
            for server in self.servers.values():
                undo.callback(server.end)
                server.begin()
            for server in self.servers.values():
                server.wait()
            robot.read_line(READY_S)
            self._undo = undo.pop_all()

    def client(self, place: str, role: str, **settings: object) -> LabProcess:
        """Start a client at the robot, or at a server: a role of ``robot.py`` and its settings."""
        return self.process(place, role, [str(_HERE / "robot.py"), role, json.dumps(settings)])

    def process(self, node: str, what: str, arguments: Sequence[str]) -> LabProcess:
        """Start a Python process in a namespace, in its ROS domain, with one thread for linear algebra."""
        threads = ["OPENBLAS_NUM_THREADS=1", "OMP_NUM_THREADS=1"]  # a machine here has one core
        environment = [*ros_environment(self._nodes.files, self._domain(node)), *threads]
        return self._lab.start(node, what, arguments, environment)

    def _domain(self, node: str) -> int:
        return _DOMAIN + 1 + self._machines.index(node) if node in self._machines else _DOMAIN

    def _admit(self, node: str, served: Sequence[Served]) -> str:
        """Give a proxy the delegations of its side, and write its configuration; return the file."""
        side: Side = "import" if node == ROBOT else "expose"
        carried = [each.carried(side) for each in served if node == ROBOT or node in each.machines]
        return self._nodes.admit_proxy(node, self._domain(node), {side: carried})

    def _topology(self) -> Topology:
        links = [(ROBOT, _NEAR), (_NEAR, _GATE)]
        for machine in self._machines:
            relay = self._relays.get(machine)
            links += [(_GATE, machine)] if relay is None else [(_GATE, relay), (relay, machine)]
        nodes = (ROBOT, _NEAR, _GATE, *self._relays.values(), *self._machines)
        return flat_topology(links, mtu=_MTU, rib=_GATE, members=(ROBOT, *self._machines), switches=nodes)
