"""Baselines of the message bench: ways to carry a message on the row, each with its processes by machine.

I/O. Starts processes.

GDP has a switch on each of the three in the middle, the RIB at s2, and a member at A and at B. Zenoh has a router on
each of the three and a client at either end, with mutual TLS; every hop is a link of its own, so a message is encrypted
and decrypted at each. Cyclone DDS is unsecured: peers by address, no multicast, the kernel forwards IPv4; all its other
settings are the defaults, including its packet sizes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any, Final, Literal, Protocol

from gdp.trust.right import Right
from lab.machines import BenchNodes
from lab.process import LabProcess
from lab.topology import LEFT, MIDDLE, RIGHT
from peers.certificates import make_certificates
from peers.chain import NODES, Chain, address
from peers.gdp_endpoint import PING, PONG

_GDP: Final = "peers.gdp_endpoint"
_ZENOH: Final = "peers.zenoh_endpoint"
_CYCLONE: Final = "peers.cyclone_endpoint"
_ZENOH_PORT: Final = 7447
_READY_S: Final = 20.0
_MEASURED_S: Final = 180.0

Measured = Mapping[str, Any]  # what ``exchange`` returns
Pids = Mapping[str, Sequence[int]]
Settings = Mapping[str, object]


class Baseline(Protocol):
    """A way to carry messages."""

    @property
    def name(self) -> str:
        """Return the name of its row."""

    def measure(self, chain: Chain, size: int, count: int) -> Measured:
        """Start its processes, and measure messages of one size.

        Raises ``FailedError``: it is not installed, or did not come up, or lost a message.
        """


class GdpNet:
    """Switches with the data plane ``kernel``. ``sign``: what authenticates messages."""

    def __init__(self, sign: Literal["always", "session"]) -> None:
        self.name = "gdp-kernel" if sign == "always" else "gdp-kernel-session"
        self._sign = sign

    def measure(self, chain: Chain, size: int, count: int) -> Measured:
        """Start switches, RIB, B, A; as ``Baseline.measure``."""
        with ExitStack() as stack:
            nodes = stack.enter_context(BenchNodes(chain, MIDDLE, plane="kernel", label=self.name))
            ends = [{"sign": self._sign, "config": str(self._admit(nodes, node))} for node in (LEFT, RIGHT)]
            between = [each.pid for (role, _), each in nodes.running.items() if role == "switch"]
            return _measured(stack, chain, _GDP, ends, {"between": between}, size=size, count=count)

    def _admit(self, nodes: BenchNodes, node: str) -> object:
        if self._sign == "session":
            return nodes.admit_member(node, {Right.CALL if node == LEFT else Right.SERVE: [PING]})
        written, read = (PING, PONG) if node == LEFT else (PONG, PING)
        return nodes.admit_member(node, {Right.PUBLISH: [written], Right.READ: [read]})


class ZenohNet:
    """Zenoh with mutual TLS."""

    name = "zenoh-mtls"

    def measure(self, chain: Chain, size: int, count: int) -> Measured:
        """Start routers from the left, then B, then A; as ``Baseline.measure``."""
        with ExitStack() as stack:
            routers = []
            for before, node in zip(NODES, MIDDLE, strict=False):
                upstream = before if before in MIDDLE else None
                own = {"listen": [f"tls/0.0.0.0:{_ZENOH_PORT}"], **self._own(chain, node, upstream)}
                routers.append(stack.enter_context(_start(chain, node, _ZENOH, "router", {"own": own})))
                routers[-1].read(_READY_S)
            pairs = ((LEFT, MIDDLE[0]), (RIGHT, MIDDLE[-1]))
            ends = [{"own": self._own(chain, node, router)} for node, router in pairs]
            pids = {"between": [each.pid for each in routers]}
            return _measured(stack, chain, _ZENOH, ends, pids, size=size, count=count)

    def _own(self, chain: Chain, node: str, router: str | None) -> dict[str, object]:
        """Return the router that a machine connects to, and its certificate; the first call makes all of them."""
        directory = chain.directory / "tls"
        if not directory.exists():
            hosts = {host: [address(host, each) for each in chain.topology.neighbours(host)] for host in NODES}
            make_certificates(directory, hosts)
        connect = [f"tls/{address(router, node)}:{_ZENOH_PORT}"] if router else []
        return {"connect": connect, "certificate": str(directory / node)}


def cyclone_xml(own: str, other: str) -> str:
    """Return the configuration of an end at the IPv4 address ``own``, whose only peer is at ``other``."""
    return (
        f'<CycloneDDS><Domain id="any"><General><Interfaces><NetworkInterface address="{own}"/></Interfaces>'
        "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f'<MaxAutoParticipantIndex>1</MaxAutoParticipantIndex><Peers><Peer address="{other}"/></Peers></Discovery>'
        "</Domain></CycloneDDS>"
    )


class CycloneNet:
    """Cyclone DDS, reliable."""

    name = "cyclone"

    def measure(self, chain: Chain, size: int, count: int) -> Measured:
        """Start B, then A; as ``Baseline.measure``."""
        left, right = address(LEFT, NODES[1]), address(RIGHT, NODES[-2])
        ends = [{"xml": cyclone_xml(*each)} for each in ((left, right), (right, left))]
        with ExitStack() as stack:
            return _measured(stack, chain, _CYCLONE, ends, {}, size=size, count=count)


BASELINES: Final[Mapping[str, Baseline]] = {
    each.name: each for each in (GdpNet("always"), GdpNet("session"), ZenohNet(), CycloneNet())
}


def _measured(
    stack: ExitStack, chain: Chain, module: str, ends: Sequence[Settings], pids: Pids, **load: int
) -> Measured:
    """Start the endpoints at B and A with their settings, which ``ends`` has of A and of B; return the figures of A."""
    pong = stack.enter_context(_start(chain, RIGHT, module, "pong", ends[1]))
    pong.read(_READY_S)
    settings = {**ends[0], **load, "pids": {"receiver": [pong.pid], **pids}}
    return stack.enter_context(_start(chain, LEFT, module, "ping", settings)).read(_MEASURED_S)


def _start(chain: Chain, node: str, module: str, role: str, settings: Settings) -> LabProcess:
    return chain.start(node, f"{module.rpartition('.')[2]}-{role}", ["-m", module, role, json.dumps(settings)])
