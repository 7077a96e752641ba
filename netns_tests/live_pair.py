"""Two machines joined by a cable: switches, a RIB, real ROS graphs, a proxy for each graph, and their nodes.

::

    a: graph "a" (ROS 2)      [switch a, RIB] ---- [switch b]      graphs "b" (ROS 2), "one" (ROS 1), "dds" (ROS 2) :b

Graph "b" has two proxies: "b" and "twin". Nodes keep to their machine: there is no IP address but loopback's, and
Fast DDS uses no shared memory, which would cross. The domains differ, too.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import Final

from gdp.crypto.certificates import Role
from gdp.host.run_registry import Run
from gdp.stores.keyring import load_identity
from lab.credentials import Carried, Kind, OverlayCredentials, Side
from lab.machines import Lab, OverlayNodes
from lab.process import LabProcess, new_run, python_path
from lab.topology import Attachment, DomainPlan, Link, Topology
from netns_tests.lifetimes import LEASE_S, LEASES, Lifetime, noted
from proxy.endpoints.core.endpoint import proxy_node_name
from tests.gdp_extensions.dds.peers import CYCLONE
from tests.proxy.endpoints.ros1_net import need_ros1
from tests.proxy.endpoints.ros2_net import DOMAIN, Peer

PATIENCE_S: Final = 30.0
_MASTER: Final = "http://127.0.0.1:11311"
_DOMAINS: Final = {"a": DOMAIN, "b": DOMAIN + 1, "twin": DOMAIN + 1, "dds": DOMAIN + 2}
_GRAPHS: Final[dict[str, dict[str, object]]] = {
    "a": {"endpoint": "ros2", "domain": _DOMAINS["a"]},
    "b": {"endpoint": "ros2", "domain": _DOMAINS["b"]},
    "twin": {"endpoint": "ros2", "domain": _DOMAINS["twin"]},
    "dds": {"endpoint": "dds", "domain": _DOMAINS["dds"]},
    "one": {"endpoint": "ros1", "master": _MASTER},
}
_ENVIRONMENT: Final = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",  # LOCALHOST would bring shared memory back
    "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    "CYCLONEDDS_URI": CYCLONE,
    "ROS_MASTER_URI": _MASTER,
    "ROS_HOSTNAME": "127.0.0.1",
}
_TOPOLOGY: Final = Topology(
    links=(Link("a", "b"),),
    domains=(DomainPlan("pair", ("a", "b")),),
    attachments=(
        Attachment("a", "rib", "rib"),
        *(Attachment("a" if label == "a" else "b", "proxy", f"to_{label}") for label in _GRAPHS),
    ),
)


@dataclass(frozen=True, slots=True)
class Crossing:
    """Return the rule of a source and one rule of each reader; ``options``: further keys of all of them."""

    name: str
    type_name: str
    sources: str
    readers: str
    kind: Kind = "topic"
    options: Mapping[str, object] = field(default_factory=dict)

    @property
    def carried(self) -> Carried:
        """Return it as proxies carry it."""
        return Carried(self.name, self.type_name, self.kind, self.options)


class Proxy:
    """``gdp-proxy`` process at a ``machine``, which can be killed and started again."""

    def __init__(self, pair: Pair, label: str) -> None:
        self._pair = pair
        self._label = label
        self.machine = "a" if label == "a" else "b"
        self._process: LabProcess | None = None
        self._port = 9_110 + list(_GRAPHS).index(label)

    @property
    def pid(self) -> int:
        """Return its process number."""
        assert self._process is not None
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Return whether it was started and has not ended."""
        return self._process is not None

    @property
    def node_name(self) -> str:
        """Return the name of its virtual node."""
        return proxy_node_name(load_identity(self._pair.identity(self._label), time.time()).name.to_text())

    @property
    def said(self) -> str:
        """Return its log since the first start."""
        return (self._pair.folder / f"proxy-{self._label}.log").read_text()

    def start(self) -> None:
        """Start it; return when it is attached."""
        self._process = self._pair.start_proxy(self._label, self._port)

    def end(self, how: signal.Signals = signal.SIGTERM) -> None:
        """End it, by signal or kill; idempotent."""
        process, self._process = self._process, None
        if process is not None:
            process.finish(how, PATIENCE_S)

    def warnings(self, name: str) -> list[str]:
        """Return its warnings about a local name: fault and detail."""
        return re.findall(rf" WARNING {re.escape(name)}: (.*)", self.said)

    def faults(self, fault: str) -> int:
        """Return the metric of a fault."""
        return int(self.metric(f'gdp_proxy_faults_total{{fault="{fault}"}}'))

    def metric(self, name: str) -> float:
        """Return the value of a metric, zero where it is not there."""
        ask = partial(_metrics, self._port)
        text = self._pair.spaces[self.machine].inside(ask)
        found = re.search(rf"^{re.escape(name)} (\S+)$", text, re.MULTILINE)
        return float(found[1]) if found else 0.0

    def descriptors(self) -> int:
        """Return its number of open files."""
        return len(os.listdir(f"/proc/{self.pid}/fd"))

    def memory_kib(self) -> int:
        """Return its resident memory."""
        found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{self.pid}/status").read_text())
        assert found is not None
        return int(found[1])


class Pair:
    """All running processes. Proxies and the ROS 1 master start on first use."""

    def __init__(
        self,
        run: Run,
        undo: ExitStack,
        crossings: Sequence[Crossing],
        hidden: Mapping[str, str],
        lease_s: float,
        pythons: Mapping[str, Path],
    ) -> None:
        self.folder = run.directory
        lab = Lab(run, _TOPOLOGY)
        self.spaces, self.machines = lab.namespaces, lab.machines
        self._undo = undo
        for each in self.machines.values():
            undo.enter_context(each).environment |= {**_ENVIRONMENT, "ROS_LOG_DIR": str(self.folder / "ros")}
        self._crossings = crossings
        self._hidden = hidden
        self._pythons = pythons
        self._proxies = {label: Proxy(self, label) for label in _GRAPHS}
        self._master: LabProcess | None = None
        self._nodes: dict[str, Peer] = {}
        self._credentials = OverlayCredentials(_TOPOLOGY, self.folder, lease_s=lease_s)
        undo.enter_context(OverlayNodes(lab, self._credentials)).stand_up(_TOPOLOGY.nodes, "auto")

    def proxy(self, label: str) -> Proxy:
        """Return a running proxy."""
        proxy = self._proxies[label]
        if not proxy.is_running:
            if label == "one":
                self.start_master()
            proxy.start()
        return proxy

    def node(self, graph: str, name: str = "") -> Peer:
        """Return a node of a graph whose proxy runs; without a name always the same one."""
        self.proxy(graph)
        if name or graph not in self._nodes:
            made = self._make_node(graph, name or f"node_{graph}")
            if name:
                return made
            self._nodes[graph] = made
        return self._nodes[graph]

    def outlive(self) -> None:
        """Return when the present advertisements of the proxies have been renewed for three leases."""
        began_s, lasts_s = time.monotonic(), (LEASES + 0.5) * LEASE_S
        time.sleep(lasts_s)
        noted.append(Lifetime("the pair", LEASE_S, time.monotonic() - began_s))

    def shape(self, rate: str) -> None:
        """Limit the traffic from machine "a" to "b", such as ``20mbit``; empty: no limit."""
        words = ["add", "dev", "b", "root", "tbf", "rate", rate, "burst", "32kb", "latency", "50ms"]
        change = words if rate else ["del", "dev", "b", "root"]
        self.machines["a"].output("tc", "qdisc", *change)

    def start_master(self) -> None:
        """Start the ROS 1 master, if it does not run."""
        if self._master is None:
            need_ros1()
            argv = [sys.executable, "-m", "ring.nodes", "1", "master", _MASTER.rpartition(":")[2]]
            self._master = self.machines["b"].launch(argv, "master")
            self._master.read_until("ready", patience_s=PATIENCE_S)

    def stop_master(self) -> None:
        """Kill the ROS 1 master."""
        process, self._master = self._master, None
        assert process is not None
        process.kill_group()

    def start_proxy(self, label: str, port: int) -> LabProcess:
        """Start a proxy, and return it when it is attached."""
        config, words = self._write_proxy(label, port), self._environment(label)
        if label in self._hidden:
            words.append(f"PYTHONPATH={python_path(self._hide(self._hidden[label]))}")
        machine = self.machines[self._proxies[label].machine]
        return machine.ready(machine.launch_node("proxy", config.stem, before=[*words, *self._other_python(label)]))

    def identity(self, label: str, role: Role = Role.PROXY) -> Path:
        """Return the directory of a node's keys."""
        return self._credentials.identity(role, label)

    def _write_proxy(self, label: str, port: int) -> Path:
        if (path := self._credentials.file("proxy", label)).exists():
            return path
        (at,) = (each for each in _TOPOLOGY.attached("proxy") if each.ifname == f"to_{label}")
        self._credentials.admit(Role.PROXY, label, at.switch)
        rules: dict[Side, list[Carried]] = {
            "expose": [each.carried for each in self._crossings if label in each.sources.split()],
            "import": [each.carried for each in self._crossings if label in each.readers.split()],
        }
        return self._credentials.proxy(at, rules, label=label, ros=_GRAPHS[label], metrics={"port": port})

    def _hide(self, package: str) -> Path:
        """Return a folder, first on the path, that holds only an empty package of this name."""
        (self.folder / "hidden" / package).mkdir(parents=True, exist_ok=True)
        (self.folder / "hidden" / package / "__init__.py").touch()
        return self.folder / "hidden"

    def _make_node(self, graph: str, name: str) -> Peer:
        machine = "a" if graph == "a" else "b"
        words = [*self.spaces[machine].command([]), *self._environment(graph)]
        if graph == "one":
            logs = {"ROS_LOG_DIR": str(self.folder / "ros"), "PYTHONPATH": python_path(Path(need_ros1()))}
            program = Path(__file__).with_name("live_nodes.py")
            # of its errors most are rospy's retries while a master is away
            node = Peer(name, words, {**_ENVIRONMENT, **logs}, program, subprocess.DEVNULL)
        else:
            node = Peer(name, [*words, *self._other_python(graph)], _ENVIRONMENT)
        self._undo.callback(node.end)
        node.tell("!from netns_tests.live_nodes import values")
        return node

    def _other_python(self, label: str) -> list[str]:
        """Return the words that replace this interpreter, the next word, by a graph's own."""
        python, ours = (
            self._pythons.get(label),
            "LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE",
        )  # set by wheels of ROS
        return [] if python is None else ["sh", "-c", f'unset {ours}; shift; exec {python} "$@"', "sh"]

    def _environment(self, label: str) -> list[str]:
        """Return the command prefix that puts a command into a graph and hides the other graphs from it."""
        domain = [f"ROS_DOMAIN_ID={_DOMAINS[label]}"] if label in _DOMAINS else []
        return ["env", f"ROS_LOG_DIR={self.folder / 'ros'}", *domain]


@contextmanager
def pair_of(
    *crossings: Crossing,
    hidden: Mapping[str, str] | None = None,
    lease_s: float = LEASE_S,
    pythons: Mapping[str, Path] | None = None,
) -> Iterator[Pair]:
    """Two machines with proxies for these rules. All ends on leaving.

    Args:
        hidden: a package that a proxy lacks, by graph.
        pythons: interpreters with another distribution of ROS 2, by graph.
    """
    with new_run() as run, ExitStack() as undo:
        yield Pair(run, undo, crossings, hidden or {}, lease_s, pythons or {})


def _metrics(port: int) -> str:
    end_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE_S) as answer:
                return str(answer.read(), "utf-8")
        except urllib.error.HTTPError as error:
            if error.code != HTTPStatus.SERVICE_UNAVAILABLE or time.monotonic() >= end_s:
                raise
        time.sleep(0.1)  # a node answers a limited number of scrapes a second
