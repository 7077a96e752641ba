"""Bootstrap bundles of a cluster's machines, of gateways and of the robot's side: their files and programs.

I/O, through ``members``. A machine's bundle contains no key, only the token with which it joins the domain. Every file
refers to others by relative paths, so a bundle works in any folder.
Errors are those of ``Authority.enrol``.
::

    machine   [node ...] -- ROS graph of its own -- [proxy] -- [leaf] -- iface          towards the gateway
                                        of a replica gateway   [switch] -- uplink       while it is the gateway
    rented    the same, with a leaf as `gdp join` made it -- tunnel -- border;  and the member's [agent], [relay]
    gateway   ifaces -- [switch] -- ifaces
    robot     ROS graph of the robot -- [proxy] -- [switch] -- uplink                   and [rib], and the watch
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import yaml

from fog.bootstrap.members import Authority
from fog.cluster import CloudNode, ClusterPlan, ExportedInterface
from fog.host.bundle import JOIN_FILE, MEMBER_FOLDER
from fog.host.joining import join_file
from fog.machine import MachineBundle, Program
from gdp.crypto.certificates import Role
from gdp.intervals import ADVERTISEMENT
from gdp.stores.keyring import DELEGATIONS
from gdp.trust.join_token import JoinToken

PROXY: Final = "proxy"
SWITCH: Final = "switch"
# Fast DDS 3 and later, and earlier versions
_PROFILES: Final = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
_DOMAINS: Final = 100  # number of ROS domains of machines, so that two adjacent machines never share one
_TABLE_MAX: Final = 8_192  # a machine uses few names, and clearing memory for the usual 131,072 takes time
_OWNER: Final = "owner.pub"
_PROXY_IFACE: Final = "proxy0"
_AWAIT: Final = ("--await-iface", "30")  # the switch of the same machine creates the device
_UDP_ONLY: Final = {
    # On a shared host, shared memory would join the graphs of machines; the range LOCALHOST enables it again.
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
"""  # nodes that start together often miss the first announcements; the next would follow after 3 s


@dataclass(frozen=True, slots=True)
class RobotDevices:
    """Devices of the robot's switch: the port towards the machines, and the devices for local nodes."""

    uplink: str
    proxy: str
    rib: str
    watch: str


def machine_label(cluster: str, name: str) -> str:
    """Return the label of a machine's nodes in the domain."""
    return f"{cluster}-{name}"


def machine_boot(
    plan: ClusterPlan,
    name: str,
    command: Callable[[CloudNode], Sequence[str]],
    token: JoinToken,
    *,
    iface: str = "",
    uplink: str = "",
    lease_s: float = ADVERTISEMENT.lease_s,
    has_relay: bool = False,
    software: Mapping[str, bytes] | None = None,
) -> MachineBundle:
    """Return the bootstrap bundle of a machine that joins a domain; its only secret is the token.

    Args:
        iface: device of a machine of this host; empty: a rented one, which has a tunnel to the border, and an agent.
        uplink: device that a machine of this host has while it is the gateway of its group; empty: it never is.
        has_relay: the border relays through TLS; a rented machine then runs the member's end of it, too.
        software: further files, by which the machine fetches its software.
    """
    proxy = {**_who(f"{MEMBER_FOLDER}/{PROXY}"), "delegations": f"{MEMBER_FOLDER}/{PROXY}/{DELEGATIONS}"}
    files = {
        JOIN_FILE: join_file(token, machine_label(plan.name, name)),
        _PROFILE: _OFTEN,
        **(software or {}),
        "proxy.yaml": _yaml(_serving_proxy(proxy, plan, name, f"{MEMBER_FOLDER}/{_OWNER}", lease_s)),
    }
    environment = _environment(plan, name)
    if iface:
        ports = [{"iface": iface}, *([{"iface": uplink, "optional": True}] if uplink else [])]
        switch = {**_who(f"{MEMBER_FOLDER}/{SWITCH}"), "ports": ports}
        files["switch.yaml"] = _yaml({**switch, "attach": [_PROXY_IFACE], "table_max": _TABLE_MAX})
        environment |= _UDP_ONLY
        return MachineBundle(files, (*_nodes(plan, command, environment), _switch(), _proxy(environment)))
    relay = [_member_program("relay", "gdp.cli.relay", "--config", "relay.yaml")] if has_relay else []
    programs = (
        *_nodes(plan, command, environment),
        _member_program(SWITCH, "gdp.cli.switch", "--config", "switch.yaml", ready=" is up"),
        *relay,
        _proxy(environment),
        Program("agent", ("{python}", "-m", "gdp.cli.gdp", "agent", f"{{home}}/{MEMBER_FOLDER}"), "agent of "),
    )
    return MachineBundle(files, programs)


def node_names(plan: ClusterPlan) -> list[str]:
    """Return the program names of a cluster's nodes, the same on each machine."""
    return ["node"] if len(plan.nodes) == 1 else [f"node{index}" for index in range(len(plan.nodes))]


def gateway_boot(authority: Authority, label: str, ifaces: Sequence[str], *, days: float) -> MachineBundle:
    """Enrol a gateway: a switch between its devices."""
    switch = authority.enrol(Role.SWITCH, f"gateway-{label}", SWITCH, days=days)
    content = _yaml({**_who("switch"), "ports": [{"iface": iface} for iface in ifaces]})
    return MachineBundle({**switch, "switch.yaml": content}, (_switch(),))


def robot_boot(authority: Authority, devices: RobotDevices, *, days: float) -> MachineBundle:
    """Enrol the robot's side of a site without ``fog.yaml``: switch, RIB and proxy."""
    attach = [devices.proxy, devices.rib, devices.watch]
    switch = {"ports": [{"iface": devices.uplink}], "attach": attach, "revocations": "revocations"}
    files = authority.enrol(Role.PROXY, "supervisor", "watch", days=days)
    for role in (Role.SWITCH, Role.RIB, Role.PROXY):
        files |= authority.enrol(role, "robot", role.value, days=days)
    files |= {
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
    """Return the rule by which the robot imports an interface, without the owner."""
    return {**_rule(carried), **carried.options}


def _ros_domain(name: str) -> int:
    return 1 + int(name[1:]) % _DOMAINS


def _environment(plan: ClusterPlan, name: str) -> dict[str, str]:
    """Return the variables of a machine's nodes and of its proxy."""
    named = {"FOG_CLUSTER": plan.name, "FOG_MACHINE": name, "ROS_DOMAIN_ID": str(_ros_domain(name))}
    return named | dict.fromkeys(_PROFILES, f"{{home}}/{_PROFILE}")


def _nodes(
    plan: ClusterPlan, command: Callable[[CloudNode], Sequence[str]], environment: Mapping[str, str]
) -> list[Program]:
    """Return the programs of the user's nodes."""
    return [
        Program(title, tuple(command(node)), environment={**environment, **node.environment}, is_users=True)
        for title, node in zip(node_names(plan), plan.nodes, strict=True)
    ]


def _serving_proxy(
    who: Mapping[str, object], plan: ClusterPlan, name: str, owner: str, lease_s: float
) -> dict[str, object]:
    """Return the configuration of the proxy that serves a cluster's interfaces; ``who``: its keys and domain."""
    return {
        **who,
        "iface": _PROXY_IFACE,
        "lease_s": lease_s,
        "ros": {"endpoint": "ros2", "domain": _ros_domain(name), "exclusive": True},
        "expose": [{**_rule(each), **each.served, "owner": owner} for each in plan.carried],
    }


def _member_program(name: str, module: str, *words: str, ready: str = "") -> Program:
    """Return a program with a configuration, the last word, that `gdp join` wrote."""
    return Program(name, ("{python}", "-m", module, *words[:-1], f"{{home}}/{MEMBER_FOLDER}/{words[-1]}"), ready)


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
