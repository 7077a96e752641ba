"""Baselines of the message bench: ways to carry a message on the row, each with its processes by machine.

I/O. Starts processes.

GDP has a switch on each of the three in the middle, the RIB at s2, and a member at A and at B. Zenoh has a router on
each of the three and a client at either end, with mutual TLS; every hop is a link of its own, so a message is encrypted
and decrypted at each. Cyclone DDS is unsecured: peers by address, no multicast, the kernel forwards IPv4; all its other
settings are the defaults, including its packet sizes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any, Final, Literal

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
Baseline = Callable[..., Measured]
"""Starts the processes of a way to carry messages on a chain, and measures ``count`` of ``size`` bytes.

Raises ``FailedError``: it is not installed, or did not come up, or lost a message.
"""


def measure_gdp(chain: Chain, *, sign: Literal["always", "session"], **load: int) -> Measured:
    """Start switches with the data plane ``kernel``, RIB, B, A. ``sign``: what authenticates messages."""
    rights: dict[str, dict[Right, list[str]]] = {
        LEFT: {Right.PUBLISH: [PING], Right.READ: [PONG]},
        RIGHT: {Right.PUBLISH: [PONG], Right.READ: [PING]},
    }
    if sign == "session":
        rights = {LEFT: {Right.CALL: [PING]}, RIGHT: {Right.SERVE: [PING]}}
    with ExitStack() as stack:
        nodes = stack.enter_context(BenchNodes(chain, MIDDLE, plane="kernel", label=f"gdp-{sign}"))
        ends = [{"sign": sign, "config": str(nodes.admit_member(*each))} for each in rights.items()]
        between = [each.pid for (role, _), each in nodes.running.items() if role == "switch"]
        return _measured(stack, chain, _GDP, ends, {"between": between}, **load)


def measure_zenoh(chain: Chain, **load: int) -> Measured:
    """Start Zenoh with mutual TLS: routers from the left, then B, then A."""
    directory = chain.directory / "tls"
    hosts = {host: [address(host, each) for each in chain.topology.neighbours(host)] for host in NODES}
    make_certificates(directory, hosts)

    def own(node: str, router: str | None) -> Settings:
        connect = [f"tls/{address(router, node)}:{_ZENOH_PORT}"] if router else []
        return {"connect": connect, "certificate": str(directory / node)}

    with ExitStack() as stack:
        routers = []
        for before, node in zip(NODES, MIDDLE, strict=False):
            listening = {"listen": [f"tls/0.0.0.0:{_ZENOH_PORT}"], **own(node, before if before in MIDDLE else None)}
            routers.append(stack.enter_context(_start(chain, node, _ZENOH, "router", {"own": listening})))
            routers[-1].read(_READY_S)
        ends = [{"own": own(node, router)} for node, router in ((LEFT, MIDDLE[0]), (RIGHT, MIDDLE[-1]))]
        return _measured(stack, chain, _ZENOH, ends, {"between": [each.pid for each in routers]}, **load)


def cyclone_xml(own: str, other: str) -> str:
    """Return the configuration of an end at the IPv4 address ``own``, whose only peer is at ``other``."""
    return (
        f'<CycloneDDS><Domain id="any"><General><Interfaces><NetworkInterface address="{own}"/></Interfaces>'
        "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f'<MaxAutoParticipantIndex>1</MaxAutoParticipantIndex><Peers><Peer address="{other}"/></Peers></Discovery>'
        "</Domain></CycloneDDS>"
    )


def measure_cyclone(chain: Chain, **load: int) -> Measured:
    """Start B and A of Cyclone DDS, reliable."""
    left, right = address(LEFT, NODES[1]), address(RIGHT, NODES[-2])
    ends = [{"xml": cyclone_xml(*each)} for each in ((left, right), (right, left))]
    with ExitStack() as stack:
        return _measured(stack, chain, _CYCLONE, ends, {}, **load)


BASELINES: Final[Mapping[str, Baseline]] = {
    "gdp-kernel": partial(measure_gdp, sign="always"),
    "gdp-kernel-session": partial(measure_gdp, sign="session"),
    "zenoh-mtls": measure_zenoh,
    "cyclone": measure_cyclone,
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
