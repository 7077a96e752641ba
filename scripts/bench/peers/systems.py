"""Baselines of the message bench: ways to carry a message on the row, each with its processes by machine.

I/O. Starts processes.

GDP has a switch on each of the three in the middle, the RIB at s2, and a member at A and at B. Zenoh has a router on
each of the three and a client at either end, with mutual TLS; every hop is a link of its own, so a message is encrypted
and decrypted at each. Cyclone DDS is unsecured: peers by address, no multicast, the kernel forwards IPv4; all its other
settings are the defaults, including its packet sizes.
"""

from __future__ import annotations

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
from peers.jsonl import EndSettings

_GDP: Final = "peers.gdp_endpoint"
_ZENOH: Final = "peers.zenoh_endpoint"
_CYCLONE: Final = "peers.cyclone_endpoint"
_ZENOH_PORT: Final = 7447
_READY_S: Final = 20.0
_MEASURED_S: Final = 180.0

Measured = Mapping[str, Any]  # what ``exchange`` returns
Pids = Mapping[str, Sequence[int]]


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
            own = [{"sign": self._sign, "config": str(self._admit(nodes, node))} for node in (LEFT, RIGHT)]
            between = [each.pid for (role, _), each in nodes.running.items() if role == "switch"]
            return _measured(stack, chain, _GDP, own, {"between": between}, (size, count))

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
                own = {"listen": f"tls/0.0.0.0:{_ZENOH_PORT}", **self._identity(chain, node)}
                if before in MIDDLE:
                    own["connect"] = self._at(before, node)
                settings = EndSettings("router", 0, 0, {}, own)
                started = chain.start(node, "zenoh_router", ["-m", _ZENOH, settings.to_argument()])
                routers.append(stack.enter_context(started))
                routers[-1].read(_READY_S)
            ends = [
                {"connect": self._at(router, node), **self._identity(chain, node)}
                for node, router in ((LEFT, MIDDLE[0]), (RIGHT, MIDDLE[-1]))
            ]
            return _measured(stack, chain, _ZENOH, ends, {"between": [each.pid for each in routers]}, (size, count))

    def _at(self, router: str, towards: str) -> str:
        return f"tls/{address(router, towards)}:{_ZENOH_PORT}"

    def _identity(self, chain: Chain, node: str) -> dict[str, str]:
        """Return the path of a machine's certificate; the first call makes all of them."""
        directory = chain.directory / "tls"
        if not directory.exists():
            hosts = {host: [address(host, each) for each in chain.topology.neighbours(host)] for host in NODES}
            make_certificates(directory, hosts)
        return {"certificate": str(directory / node)}


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
        own = [{"xml": cyclone_xml(*each)} for each in ((left, right), (right, left))]
        with ExitStack() as stack:
            return _measured(stack, chain, _CYCLONE, own, {}, (size, count))


BASELINES: Final[Mapping[str, Baseline]] = {
    each.name: each for each in (GdpNet("always"), GdpNet("session"), ZenohNet(), CycloneNet())
}


def _measured(
    stack: ExitStack, chain: Chain, module: str, own: Sequence[dict[str, str]], pids: Pids, load: tuple[int, int]
) -> Measured:
    """Start the endpoints at B and A, whose settings ``own`` has in the other order; return the figures of A."""

    def start(role: str, node: str, settings: dict[str, str], counted: Pids) -> LabProcess:
        every = EndSettings(role, *load, {place: list(each) for place, each in counted.items()}, settings)
        argv = ["-m", module, every.to_argument()]
        return stack.enter_context(chain.start(node, module.rpartition(".")[2], argv))

    pong = start("pong", RIGHT, own[1], {})
    pong.read(_READY_S)
    return start("ping", LEFT, own[0], {"receiver": [pong.pid], **pids}).read(_MEASURED_S)
