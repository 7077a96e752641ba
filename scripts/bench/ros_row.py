"""The row of the benches with real ROS nodes: A - s1 - s2 - s3 - B with a proxy at either end, and a cable from A to B.

Place: shell; makes namespaces and keys, and starts the commands that robots run.
::

    a -- s1 -- s2 -- s3 -- b      overlay: all switches with the plane ``kernel``, the RIB beside s2
    |______________________|      direct: one veth pair with IPv4, which only nodes of the direct case use

With ``bridged`` the direct path is as long as the other one: three more namespaces, each with a Linux bridge::

    a -- p1 -- p2 -- p3 -- b      direct

A node is started ``direct`` or not. Direct nodes meet over the cable, in a ROS domain of their own. The others have a
domain for each end, so that nothing but the proxies joins them, and speak with their proxy inside their namespace.
Everyone uses UDP over IPv4, because the shared memory of Fast DDS crosses the namespaces of one host (the discovery
range ``LOCALHOST`` brings it in again, so the range is ``SUBNET``, and the namespaces are what confines), with socket
buffers of 4 MiB (as far as ``net.core.rmem_max`` allows): the default ones do not hold a camera image, and what takes
time is then how the middleware repairs it. ROS 2's guide to tuning says the same.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Final, Literal

import yaml
from peers.process import FailedError, Started
from pyroute2 import IPRoute

from gdp.host import netns_files
from gdp.host.run_registry import Run
from gdp.metadata import Metadata
from gdp.simulation.namespaces import Namespaces
from gdp.simulation.topology import Attachment, DomainPlan, Link, Topology
from gdp.stores.issue import delegate, install_delegation
from gdp.stores.keyring import CARD, DELEGATIONS, OWNER_PUBLIC, ROOT_CERTIFICATE
from gdp.trust.right import Right
from proxy.config import Encoding
from ring.materials import Materials

__all__ = ["BUFFER_BYTES", "DIRECT_DOMAIN", "LEFT", "READY_S", "RIGHT", "Carried", "Row"]

LEFT: Final = "a"
RIGHT: Final = "b"
READY_S: Final = 30.0
_MIDDLE: Final = ("s1", "s2", "s3")
_IFACE: Final = {LEFT: _MIDDLE[0], RIGHT: _MIDDLE[-1]}  # a device is called like the neighbour it leads to
_BRIDGES: Final = ("p1", "p2", "p3")
_ADDRESSES: Final = {LEFT: "10.98.0.1", RIGHT: "10.98.0.2"}
_DOMAINS: Final = {LEFT: 141, RIGHT: 142}
DIRECT_DOMAIN: Final = 143
_RIGHTS: Final = {"topic": (Right.PUBLISH, Right.READ), "service": (Right.SERVE, Right.CALL)}
BUFFER_BYTES: Final = 4 << 20
_PROFILE: Final = f"""<?xml version="1.0" encoding="UTF-8" ?>
<dds xmlns="http://www.eprosima.com"><profiles>
 <transport_descriptors><transport_descriptor>
  <transport_id>udp</transport_id><type>UDPv4</type>
  <sendBufferSize>{BUFFER_BYTES}</sendBufferSize><receiveBufferSize>{BUFFER_BYTES}</receiveBufferSize>
 </transport_descriptor></transport_descriptors>
 <participant profile_name="participant" is_default_profile="true"><rtps>
  <userTransports><transport_id>udp</transport_id></userTransports><useBuiltinTransports>false</useBuiltinTransports>
 </rtps></participant>
</profiles></dds>
"""
_BRIDGE: Final = "bridge"
_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Carried:
    """A topic or a service that the proxies carry. ``source``: where its publishers, or its server, are."""

    name: str
    type_name: str
    encoding: Encoding
    source: str = LEFT
    kind: Literal["topic", "service"] = "topic"

    @property
    def metadata(self) -> Metadata:
        """Return what its name in the overlay digests."""
        return Metadata({"kind": self.kind, "name": self.name, "type": self.type_name})

    def rule(self, owner: Path) -> dict[str, object]:
        """Return its rule in either proxy's configuration."""
        told = {"name": self.name, "kind": self.kind, "type": self.type_name, "encoding": self.encoding}
        return {**told, "owner": str(owner)}


class Row:
    """The row with switches, RIB and proxies running; a context manager that ends them.

    Args:
        run: of which the namespaces are.
        carried: what the proxies carry.
        mtu: of every device, the cable included.
        bridged: whether the direct path leads through three bridges instead of one cable.

    Raises:
        LocalError: the kernel refuses.
        FailedError: a process did not come up; also where ROS 2 is not installed.
    """

    def __init__(self, run: Run, carried: Sequence[Carried], *, mtu: int, bridged: bool = False) -> None:
        self._run = run
        self._undo = ExitStack()
        direct = (LEFT, *(_BRIDGES if bridged else ()), RIGHT)
        self._topology = _topology(mtu, direct)
        self._spaces = Namespaces(self._topology, run)
        for node in direct[1:-1]:
            netns_files.inside(self._spaces.path(node), _bridge)
        for node, device in ((LEFT, direct[1]), (RIGHT, direct[-2])):
            netns_files.inside(self._spaces.path(node), partial(_number, device, _ADDRESSES[node]))
        self._files = run.directory / "keys"
        self._files.mkdir(mode=0o700)
        (self._files / "dds.xml").write_text(_PROFILE, encoding="utf-8")
        materials = Materials(self._topology, self._files, metrics=False)
        with ExitStack() as undo:
            for node in _MIDDLE:
                config = str(materials.switch(node, "auto"))
                argv = ["-m", "gdp.cli.switch", "--json", "--data-plane", "kernel", "--config", config]
                took = str(undo.enter_context(self._start(node, "switch", argv)).read(READY_S).get("data_plane"))
                if not took.startswith("kernel"):
                    raise FailedError(f"the switch took the data plane {took} instead")
            (at,) = self._topology.attached("rib")
            rib = ["-m", "gdp.cli.rib", "--json", "--config", str(materials.rib(at))]
            undo.enter_context(self._start(at.switch, "rib", rib)).read(READY_S)
            proxies = []
            for node in (LEFT, RIGHT):
                argv = ["-m", "proxy.cli", "--config", self._admit(node, carried)]
                proxy = self._start(node, "proxy", argv, self._environment(_DOMAINS[node]))
                proxies.append(undo.enter_context(proxy))
            for proxy in proxies:
                proxy.read_line(READY_S)
            self.proxies = [each.pid for each in proxies]
            self._undo = undo.pop_all()

    def __enter__(self) -> Row:
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()

    def node(self, node: str, module: str, role: str, *, direct: bool, **settings: object) -> Started:
        """Start a ROS node at A or B: ``python -m module role settings``."""
        return self.process(node, role, ["-m", module, role, json.dumps(settings)], direct=direct)

    def process(self, node: str, what: str, arguments: Sequence[str], *, direct: bool) -> Started:
        """Start a Python process that is a ROS node at A or B."""
        domain = DIRECT_DOMAIN if direct else _DOMAINS[node]
        return self._start(node, what, arguments, [*self._environment(domain), f"CYCLONEDDS_URI={_cyclone(node)}"])

    def proxies_cpu_s(self) -> float:
        """Return the processor time that both proxies have used, as proc(5) counts it in ``/proc/<pid>/stat``."""
        return sum(_cpu_s(pid) for pid in self.proxies)

    def _start(self, node: str, what: str, arguments: Sequence[str], environment: Sequence[str] = ()) -> Started:
        def command(argv: Sequence[str]) -> list[str]:
            return self._spaces.command(node, ["env", *environment, *argv])

        return Started(self._run, f"{what} at {node}", command, arguments)

    def _environment(self, domain: int) -> list[str]:
        profile = self._files / "dds.xml"
        return [
            f"ROS_DOMAIN_ID={domain}",
            "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET",
            "RMW_IMPLEMENTATION=rmw_fastrtps_cpp",
            f"FASTRTPS_DEFAULT_PROFILES_FILE={profile}",  # its name before Fast DDS 3
            f"FASTDDS_DEFAULT_PROFILES_FILE={profile}",
        ]

    def _admit(self, node: str, carried: Sequence[Carried]) -> str:
        """Let a proxy carry its side of everything, and write its configuration; return the file."""
        identity, owner = self._files / "nodes" / f"proxy-{node}", self._files / "owner"
        sides: dict[str, list[dict[str, object]]] = {"expose": [], "import": []}
        for each in carried:
            is_source = each.source == node
            right = _RIGHTS[each.kind][not is_source]
            install_delegation(identity, delegate(owner, identity / CARD, each.metadata, [right]))
            sides["expose" if is_source else "import"].append(each.rule(owner / OWNER_PUBLIC))
        content = {
            "identity": str(identity),
            "domain": {"root": str(self._files / "domains" / "row" / ROOT_CERTIFICATE)},
            "iface": _IFACE[node],
            "delegations": str(identity / DELEGATIONS),
            "ros": {"endpoint": "ros2", "domain": _DOMAINS[node]},
            **sides,
        }
        path = self._files / f"proxy-{node}.yaml"
        path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
        return str(path)


def _topology(mtu: int, direct: Sequence[str]) -> Topology:
    nodes = (LEFT, *_MIDDLE, RIGHT)
    return Topology(
        links=tuple(Link(a, b, mtu=mtu) for a, b in [*pairwise(nodes), *pairwise(direct)]),
        domains=(DomainPlan("row", (*nodes, *direct[1:-1])),),
        attachments=(
            Attachment("s2", "rib", "rib"),
            Attachment(LEFT, "proxy", "end"),
            Attachment(RIGHT, "proxy", "end"),
        ),
    )


def _number(device: str, address: str) -> None:
    with IPRoute() as here:
        (index,) = here.link_lookup(ifname=device)
        here.addr("add", index=index, address=address, prefixlen=24)


def _bridge() -> None:
    """Join all links of this namespace by a bridge."""
    with IPRoute() as here:
        here.link("add", ifname=_BRIDGE, kind="bridge")
        (bridge,) = here.link_lookup(ifname=_BRIDGE)
        for link in here.get_links():
            if link["index"] not in (1, bridge):  # 1 is the loopback device
                here.link("set", index=link["index"], master=bridge)
        here.link("set", index=bridge, state="up")


def _cyclone(node: str) -> str:
    """Return the configuration of Cyclone DDS for a direct node: interface, and socket buffers as the others have."""
    return (
        f'<CycloneDDS><Domain id="any"><General><Interfaces><NetworkInterface address="{_ADDRESSES[node]}"/>'
        f'</Interfaces></General><Internal><SocketReceiveBufferSize max="{BUFFER_BYTES}B"/></Internal></Domain>'
        "</CycloneDDS>"
    )


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S  # utime, stime
