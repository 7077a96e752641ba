"""Site for tests of the provider ``local``: plain programs, or a real domain with a robot's switch and RIB."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from glob import glob
from pathlib import Path
from typing import Final

import yaml

from fog.bootstrap.bundles import gateway_boot
from fog.bootstrap.members import Authority
from fog.hardware import Hardware, Offer
from fog.machine import Machine, MachineBundle, MachineSpec, MachineState, Program
from fog.providers.local.netlinks import UP
from fog.providers.local.provider import LocalProvider
from gdp.crypto.certificates import Role
from gdp.metadata import Metadata
from gdp.stores.issue import delegate, install_delegation, make_node
from gdp.stores.keyring import CARD, DELEGATIONS, ROOT_CERTIFICATE
from gdp.trust.right import Right
from lab.credentials import make_nodes
from lab.machine import LabMachine, NodeProgram
from lab.process import LabProcess, calling, python_path
from netns_tests import uplink_child

PATIENCE_S: Final = 30.0
_TICKS: Final = "import time\nprint('ready')\nwhile True:\n    time.sleep(0.01)\n    print('tick')"


def spec(name: str, region: str = "local-a", hardware: Hardware | None = None) -> MachineSpec:
    """Return a machine request."""
    has = hardware or Hardware(2, 4.0)
    return MachineSpec("test", name, Offer("local", region, "local.small", has, is_spot=True, usd_per_hour=0.01))


def machine_of(provider: LocalProvider, machine: str) -> Machine:
    """Return the provider's description of a machine."""
    (found,) = (each for each in provider.describe("test") if each.id == machine)
    return found


def is_running(provider: LocalProvider, machine: str) -> bool:
    """Return whether a machine runs."""
    return machine_of(provider, machine).state is MachineState.RUNNING


def plain_gateway(_: str, __: Sequence[str]) -> MachineBundle:
    """Return a gateway that forwards nothing."""
    return MachineBundle({}, (Program("idle", ("sleep", "1000")),))


def ticking(code: str = _TICKS) -> MachineBundle:
    """Return a machine that writes a line from time to time."""
    return MachineBundle({}, (Program("ticker", ("{python}", "-c", code), "ready"),))


def leftovers(provider_folder: Path, ids: Sequence[str]) -> list[str]:
    """Return all that is left of runs: records, folders, namespaces, groups, processes."""
    places = [provider_folder, "/tmp", "/run/netns", "/sys/fs/cgroup/*"]
    found = [path for place in places for path in glob(f"{place}/*")]  # what other tests remove meanwhile is skipped
    found += [group for path in Path("/proc").glob("[0-9]*") if (group := _group(path))]
    return [each for each in found if any(run in each for run in ids)]


def _group(process: Path) -> str:
    """Return the groups of a process; empty if it has ended, even if its parent has not reaped it."""
    try:
        is_over = (process / "stat").read_text(errors="replace").rpartition(")")[2].split()[0] in "ZX"
        return "" if is_over else (process / "cgroup").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return ""


class Domain:
    """Trust domain and the bootstrap bundles of its members; ``folder``: for keys and files.

    The robot's side runs where it was made, and ends with ``close``.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._robot = LabMachine(folder / "robot")
        make_nodes(folder, {})
        self._authority = Authority(folder / "domain", folder / "owner")

    def gateway(self, label: str, ifaces: Sequence[str]) -> MachineBundle:
        """Return the nodes of a gateway."""
        return gateway_boot(self._authority, label, ifaces, days=1)

    def machine(self, name: str) -> MachineBundle:
        """Return the nodes of a machine: a switch, and a proxy without flows."""
        files = self._switch(name, ["eth0"], ["proxy0"])
        files |= self._node(Role.PROXY, name, {"iface": "proxy0", "delegations": f"proxy/{DELEGATIONS}"})
        files[f"proxy/{DELEGATIONS}/.none"] = b""
        return MachineBundle(
            files, (_command("switch", "gdp.cli.switch"), _command("proxy", "proxy.cli.proxy", " is attached"))
        )

    def replica(self, name: str, service: Metadata) -> MachineBundle:
        """Return the nodes of a serving machine that may be its group's gateway: a switch and a participant."""
        ports = [{"iface": "eth0"}, {"iface": UP, "optional": True}]
        files = self._node(Role.SWITCH, name, {"ports": ports, "attach": ["proxy0"]})
        keys = self._member(name, service, Right.SERVE)
        files |= {f"proxy/{path.relative_to(keys)}": path.read_bytes() for path in keys.rglob("*") if path.is_file()}
        words = ("{home}/proxy", "{home}/switch/root.crt", "proxy0", "serve")
        wait = 'until ip link show proxy0 >/dev/null 2>&1; do sleep 0.05; done; exec "$@"'
        member = ("env", f"PYTHONPATH={python_path()}", "sh", "-c", wait, "member")  # a machine has no tests
        program = Program("proxy", (*member, "{python}", *calling(uplink_child.main, *words)[1:]), "up")
        return MachineBundle(files, (_command("switch", "gdp.cli.switch"), program))

    def start_robot(self, uplink: str, *attach: str) -> None:
        """Start the robot's switch and the domain's RIB in this namespace; ``attach``: further ports of the switch."""
        self._start("switch", self._switch("robot", [uplink], ["rib0", *attach]))
        self._start("rib", self._node(Role.RIB, "robot", {"iface": "rib0"}))

    def start_client(self, iface: str, service: Metadata, requests: int, size: int) -> LabProcess:
        """Start a participant at the robot's switch that calls on command; see ``uplink_child``."""
        keys, root = self._member("client", service, Right.CALL), self._folder / "domain" / ROOT_CERTIFICATE
        argv = calling(uplink_child.main, keys, root, iface, "call", requests, size)
        client = self._robot.launch(argv, "client", has_orders=True)
        assert client.read_line(PATIENCE_S) == b"up"
        return client

    def close(self) -> None:
        """End the robot's side."""
        self._robot.close()

    def _member(self, label: str, service: Metadata, right: Right) -> Path:
        keys = self._folder / f"member-{label}"
        make_node(keys, Role.PROXY, label, self._folder / "domain")
        install_delegation(keys, delegate(self._folder / "owner", keys / CARD, service, [right]))
        return keys

    def _switch(self, label: str, ifaces: Sequence[str], attach: Sequence[str] = ()) -> dict[str, bytes]:
        ports = [{"iface": iface} for iface in ifaces]
        return self._node(Role.SWITCH, label, {"ports": ports, "attach": list(attach)})

    def _node(self, role: Role, label: str, content: Mapping[str, object]) -> dict[str, bytes]:
        files = self._authority.enrol(role, label, role.value, days=1)
        reported = {"identity": role.value, "domain": {"root": f"{role.value}/root.crt"}, **content}
        return {**files, f"{role.value}.yaml": yaml.safe_dump(reported).encode()}

    def _start(self, role: NodeProgram, files: Mapping[str, bytes]) -> None:
        for path, content in files.items():
            (self._robot.folder / path).parent.mkdir(parents=True, exist_ok=True)
            (self._robot.folder / path).write_bytes(content)
            (self._robot.folder / path).chmod(0o600)
        self._robot.start(role, role)


def _command(role: str, module: str, sign: str = " is up") -> Program:
    return Program(role, ("{python}", "-m", module, "--config", f"{{home}}/{role}.yaml"), sign)
