"""What a machine of a cluster, a gateway, and the robot's own side boot: their files and programs.

Place: I/O, through ``members``. A machine's boot has no key, only the ticket with which it asks for what it is to be.
Every file names others relative to itself, so it does not matter where they will lie.
::

    machine   [node ...] -- ROS graph of its own -- [proxy] -- [leaf] -- iface          towards the gateway
                                        of a replica gateway   [switch] -- uplink       while it is the gateway
    gateway   ifaces -- [switch] -- ifaces
    robot     ROS graph of the robot -- [proxy] -- [switch] -- uplink                   and [rib], and the watch
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import yaml

from fog.cluster import CloudNode, ClusterPlan, ExportedInterface
from fog.enrolment.members import Authority
from fog.enrolment.tickets import PlannedSeat
from fog.host.bundle import TICKET_FILE
from fog.machine import MachineBundle, Program
from gdp.crypto.certificates import Role
from gdp.limits import ADVERTISEMENT_LEASE_S
from gdp.trust.enrolment import Seat, Ticket

__all__ = ["PROXY", "SWITCH", "RobotDevices", "gateway_boot", "machine_boot", "machine_seats", "node_names"]
__all__ += ["robot_boot", "robot_rule"]

PROXY: Final = "proxy"
SWITCH: Final = "switch"
_PROFILES: Final = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")  # since Fast DDS 3, and before
_DOMAINS: Final = 100  # ROS domains of machines, so that no two that lie near each other share one
_TABLE_MAX: Final = 8_192  # a machine hears of few names, and memory for the usual 131,072 takes time to clear
_OWNER: Final = "owner.pub"
_AWAIT: Final = ("--await-iface", "30")  # the switch beside it makes the device
_UDP_ONLY: Final = {
    # Where machines share a host, shared memory would join their graphs; the range LOCALHOST brings it back.
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
    "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
}
_PROFILE: Final = "fastdds.xml"
_OFTEN: Final = b"""<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com"><profiles>
 <participant profile_name="machine" is_default_profile="true"><rtps><builtin><discovery_config>
  <leaseAnnouncement><sec>0</sec><nanosec>250000000</nanosec></leaseAnnouncement>
 </discovery_config></builtin></rtps></participant>
</profiles></dds>
"""  # a node's first announcements are often missed where nodes start together; the next would come after 3 s


@dataclass(frozen=True, slots=True)
class RobotDevices:
    """What the robot's switch joins: the port towards the machines, and what it makes for those beside it."""

    uplink: str
    proxy: str
    rib: str
    watch: str


def machine_seats(plan: ClusterPlan, name: str, *, is_gateway: bool = False) -> tuple[PlannedSeat, PlannedSeat]:
    """Return what a machine of a cluster is to be: a leaf, and a proxy that gives what is carried.

    Args:
        is_gateway: it may become the gateway of its group. Then it is a switch, for it carries what is not its own.
    """
    title = f"{plan.name}-{name}"
    switch = Seat(SWITCH, Role.SWITCH if is_gateway else Role.LEAF, title)
    return PlannedSeat(switch), PlannedSeat(Seat(PROXY, Role.PROXY, title), plan.carried)


def machine_boot(
    authority: Authority,
    plan: ClusterPlan,
    name: str,
    command: Callable[[CloudNode], Sequence[str]],
    ticket: Ticket,
    *,
    iface: str,
    shares_host: bool,
    lease_s: float = ADVERTISEMENT_LEASE_S,
    uplink: str = "",
) -> MachineBundle:
    """Return what a machine of a cluster boots; nothing in it is secret but the token.

    Args:
        name: of the machine.
        command: how a node is started on it.
        ticket: for its ``machine_seats``.
        iface: its device towards the overlay.
        shares_host: whether other machines run on the same host.
        lease_s: of its claims.
        uplink: the device that it has while it is the gateway of its group; empty: it never is.
    """
    domain = 1 + int(name[1:]) % _DOMAINS
    ports = [{"iface": iface}, *([{"iface": uplink, "optional": True}] if uplink else [])]
    rules = [{**_rule(each), **each.served, "owner": _OWNER} for each in plan.carried]
    files = {
        TICKET_FILE: ticket.to_json(),
        _OWNER: authority.owner_key.read_bytes(),
        _PROFILE: _OFTEN,
        "switch.yaml": _yaml({**_who("switch"), "ports": ports, "attach": ["proxy0"], "table_max": _TABLE_MAX}),
        "proxy.yaml": _yaml(
            {
                **_who(PROXY),
                "iface": "proxy0",
                "delegations": f"{PROXY}/delegations",
                "lease_s": lease_s,
                "ros": {"endpoint": "ros2", "domain": domain, "exclusive": True},
                "expose": rules,
            }
        ),
    }
    environment = {"FOG_CLUSTER": plan.name, "FOG_MACHINE": name, "ROS_DOMAIN_ID": str(domain)}
    environment |= dict.fromkeys(_PROFILES, f"{{home}}/{_PROFILE}") | (_UDP_ONLY if shares_host else {})
    nodes = [
        Program(name, tuple(command(node)), environment={**environment, **node.environment}, is_users=True)
        for name, node in zip(node_names(plan), plan.nodes, strict=True)
    ]
    return MachineBundle(files, (*nodes, _switch(), _proxy(environment)))


def node_names(plan: ClusterPlan) -> list[str]:
    """Return what the programs of a cluster's nodes are called on each machine."""
    return ["node"] if len(plan.nodes) == 1 else [f"node{index}" for index in range(len(plan.nodes))]


def gateway_boot(authority: Authority, label: str, ifaces: Sequence[str], *, days: float) -> MachineBundle:
    """Enrol a gateway: a switch between its devices.

    Raises:
        LocalError: as ``Authority.enrol``.
    """
    switch = authority.enrol(Role.SWITCH, f"gateway-{label}", days=days)
    content = _yaml({**_who("switch"), "ports": [{"iface": iface} for iface in ifaces]})
    return MachineBundle({**switch.below("switch"), "switch.yaml": content}, (_switch(),))


def robot_boot(authority: Authority, devices: RobotDevices, *, days: float) -> MachineBundle:
    """Enrol the robot's own side of a site that has none: switch, RIB and proxy.

    Raises:
        LocalError: as ``Authority.enrol``.
    """
    members = {role: authority.enrol(role, "robot", days=days) for role in (Role.SWITCH, Role.RIB, Role.PROXY)}
    watch = authority.enrol(Role.PROXY, "supervisor", days=days)
    attach = [devices.proxy, devices.rib, devices.watch]
    switch = {"ports": [{"iface": devices.uplink}], "attach": attach, "revocations": "revocations"}
    files: dict[str, bytes] = {}
    for role, enrolled in members.items():
        files |= enrolled.below(role.value)
    files |= {
        **watch.below("watch"),
        _OWNER: authority.owner_key.read_bytes(),
        "switch.yaml": _yaml({**_who("switch"), **switch}),
        "rib.yaml": _yaml({**_who("rib"), "iface": devices.rib}),
        "proxy.yaml": _yaml(
            {
                **_who(PROXY),
                "iface": devices.proxy,
                "delegations": f"{PROXY}/delegations",
                "ros": {"endpoint": "ros2"},
            }
        ),
    }
    programs = (_switch(), _program("rib", "gdp.cli.rib", " is up", *_AWAIT), _proxy({}))
    return MachineBundle(files, programs)


def robot_rule(carried: ExportedInterface) -> dict[str, object]:
    """Return the rule by which the robot imports what is carried, without its owner."""
    return {**_rule(carried), **carried.options}


def _rule(carried: ExportedInterface) -> dict[str, object]:
    return {"name": carried.name, "kind": carried.kind, "type": carried.type_name}


def _who(folder: str) -> dict[str, object]:
    return {"identity": folder, "domain": {"root": f"{folder}/root.crt"}}


def _switch() -> Program:
    return _program("switch", "gdp.cli.switch", " is up")


def _proxy(environment: Mapping[str, str]) -> Program:
    return _program(PROXY, "proxy.cli.proxy", '"ready"', "--json", *_AWAIT, environment=environment)


def _program(
    name: str, module: str, ready: str, *options: str, environment: Mapping[str, str] | None = None
) -> Program:
    argv = ("{python}", "-m", module, "--config", f"{{home}}/{name}.yaml", *options)
    return Program(name, argv, ready, environment or {})


def _yaml(content: Mapping[str, object]) -> bytes:
    return yaml.safe_dump(dict(content), sort_keys=False).encode()
