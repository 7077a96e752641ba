"""Baselines of the message bench: ways to carry a message on the row, each with its processes by machine.

I/O. Starts processes. ``labels`` of a baseline are its rows: an encoding each, where it has several.

GDP has a switch on each of the three in the middle, the RIB at s2, and a member at A and at B. Zenoh has a router on
each of the three and a client at either end, with mutual TLS or plain TCP; every hop is a link of its own, so a message
is encrypted and decrypted at each. Cyclone DDS is unsecured: peers by address, no multicast, the kernel forwards IPv4;
all its other settings are the defaults, including its packet sizes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Final, TypeAlias

from testbed import Lab, OverlayNodes

from gdp.trust.right import Right
from lab.process import FailedError, LabProcess
from lab.topology import LEFT, MIDDLE, RIGHT
from peers.certificates import make_certificates
from peers.chain import NODES, Chain, address
from peers.exchange import Load
from peers.gdp_endpoint import PONG, ping_topic
from peers.jsonl import EndSettings

ENCODINGS: Final = ("json", "cbor", "cdr")
_GDP: Final = "peers.gdp_endpoint"
_ZENOH: Final = "peers.zenoh_endpoint"
_CYCLONE: Final = "peers.cyclone_endpoint"
_ZENOH_PORT: Final = 7447
_READY_S: Final = 20.0
_MEASURED_S: Final = 180.0


@dataclass(frozen=True, slots=True)
class Measured:
    """One size by one baseline: seconds of every message, CPU seconds a message by machine.

    ``resent``: retransmitted parts, over all sizes; known of GDP only.
    """

    label: str
    size: int
    rtt_s: tuple[float, ...]
    cpu_s: dict[str, float]
    resent: int = 0


class GdpNet:
    """Switches with one data plane.

    Args:
        plane: as ``gdp-switch --data-plane``.
        encodings: measured one after the other, by the same processes.
        path: kind of endpoint: ``library``; ``unicast`` or ``session``: a request and its response, signed or under a
            session secret.
    """

    def __init__(self, plane: str, encodings: tuple[str, ...], path: str = "library") -> None:
        self.name = f"gdp-{plane}" if path == "library" else f"gdp-{plane}-{path}"
        self._path = path
        self.labels = tuple(f"{self.name} {encoding}" for encoding in encodings)
        self._plane = plane
        self._encodings = encodings

    def measure(self, chain: Chain, load: Load) -> list[Measured]:
        """Start switches, RIB, B, A.

        Raises ``FailedError``: it is not installed, or did not come up, or lost a message.
        """
        with ExitStack() as stack:
            nodes = OverlayNodes(chain, MIDDLE, plane=self._plane, label=self.name)
            stack.callback(nodes.close)
            between = [switch.pid for switch in nodes.switches]
            pong = stack.enter_context(self._end(nodes, RIGHT, load, {}))
            pong.read(_READY_S)
            pids = {"receiver": [pong.pid], "between": between}
            ping = stack.enter_context(self._end(nodes, LEFT, load, pids))
            return ask_end(ping, dict(zip(self._encodings, self.labels, strict=True)))

    def _end(self, nodes: OverlayNodes, node: str, load: Load, pids: dict[str, list[int]]) -> LabProcess:
        pings = [ping_topic(encoding) for encoding in self._encodings]
        published, read = (pings, [PONG]) if node == LEFT else ([PONG], pings)
        rights = {Right.PUBLISH: published, Right.READ: read}
        if self._path in ("unicast", "session"):
            rights = {Right.CALL if node == LEFT else Right.SERVE: pings}
        own = {
            "config": str(nodes.admit_member(node, rights)),
            "encodings": " ".join(self._encodings),
            "path": self._path,
        }
        return start_end(nodes.lab, _GDP, node, load, own, pids)


class ZenohNet:
    """Zenoh, secured or not."""

    def __init__(self, *, secured: bool) -> None:
        self._scheme = "tls" if secured else "tcp"
        self.name = "zenoh-mtls" if secured else "zenoh-tcp"
        self.labels = (self.name,)

    def measure(self, chain: Chain, load: Load) -> list[Measured]:
        """Start routers from the left, then B, then A. Raises ``FailedError``: as ``GdpNet.measure``."""
        with ExitStack() as stack:
            routers = []
            for before, node in zip(NODES, MIDDLE, strict=False):
                own = {"listen": f"{self._scheme}/0.0.0.0:{_ZENOH_PORT}", **self._identity(chain, node)}
                if before in MIDDLE:
                    own["connect"] = self._at(before, node)
                routers.append(stack.enter_context(_router(chain, node, own)))
                routers[-1].read(_READY_S)
            pids = {"between": [each.pid for each in routers]}
            pong = stack.enter_context(self._end(chain, RIGHT, MIDDLE[-1], load, {}))
            pong.read(_READY_S)
            ping = stack.enter_context(self._end(chain, LEFT, MIDDLE[0], load, {"receiver": [pong.pid], **pids}))
            return ask_end(ping, {"zenoh": self.name})

    def _end(self, chain: Chain, node: str, router: str, load: Load, pids: dict[str, list[int]]) -> LabProcess:
        own = {"connect": self._at(router, node), **self._identity(chain, node)}
        return start_end(chain, _ZENOH, node, load, own, pids)

    def _at(self, router: str, seen_from: str) -> str:
        return f"{self._scheme}/{address(router, seen_from)}:{_ZENOH_PORT}"

    def _identity(self, chain: Chain, node: str) -> dict[str, str]:
        if self._scheme != "tls":
            return {}
        directory = chain.directory / "tls"
        if not directory.exists():
            links = chain.topology.links
            hosts = {host: [address(host, link.other(host)) for link in links if host in link.ends()] for host in NODES}
            make_certificates(directory, hosts)
        return {"certificate": str(directory / node)}


def _router(chain: Chain, node: str, own: dict[str, str]) -> LabProcess:
    settings = EndSettings("router", Load((), 0), {}, own)
    return chain.start(node, "zenoh_router", ["-m", _ZENOH, settings.to_argument()])


def cyclone_xml(own: str, other: str) -> str:
    """Return the configuration of an end at the address ``own``, of IPv4 or IPv6, whose only peer is at ``other``."""
    transport = "<Transport>udp6</Transport>" if ":" in own else ""
    return (
        f'<CycloneDDS><Domain id="any"><General>{transport}<Interfaces><NetworkInterface address="{own}"/></Interfaces>'
        "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f'<MaxAutoParticipantIndex>1</MaxAutoParticipantIndex><Peers><Peer address="{other}"/></Peers></Discovery>'
        "</Domain></CycloneDDS>"
    )


class CycloneNet:
    """Cyclone DDS, reliable."""

    name = "cyclone"
    labels = ("cyclone",)

    def measure(self, chain: Chain, load: Load) -> list[Measured]:
        """Start B, then A. Raises ``FailedError``: as ``GdpNet.measure``."""
        with ExitStack() as stack:
            pong = stack.enter_context(_cyclone_end(chain, RIGHT, load, {}))
            pong.read(_READY_S)
            ping = stack.enter_context(_cyclone_end(chain, LEFT, load, {"receiver": [pong.pid]}))
            return ask_end(ping, {"cyclone": self.name})


def _cyclone_end(chain: Chain, node: str, load: Load, pids: dict[str, list[int]]) -> LabProcess:
    left, right = address(LEFT, NODES[1]), address(RIGHT, NODES[-2])
    own, other = (left, right) if node == LEFT else (right, left)
    return start_end(chain, _CYCLONE, node, load, {"xml": cyclone_xml(own, other)}, pids)


Baseline: TypeAlias = "GdpNet | ZenohNet | CycloneNet"


def start_end(
    chain: Lab, module: str, node: str, load: Load, own: Mapping[str, str], pids: Mapping[str, Sequence[int]]
) -> LabProcess:
    """Start an endpoint, ``ping`` at A or ``pong`` at B."""
    settings = EndSettings(
        "ping" if node == LEFT else "pong", load, {place: list(each) for place, each in pids.items()}, dict(own)
    )
    return chain.start(node, module.rpartition(".")[2], ["-m", module, settings.to_argument()])


def ask_end(ping: LabProcess, labels: Mapping[str, str]) -> list[Measured]:
    """Return the figures of A.

    ``labels``: row by the name that the endpoint uses. Raises ``FailedError``: it failed.
    """
    found: list[Measured] = []
    for series, label in labels.items():
        said = ping.read(_MEASURED_S)
        sizes, resent = said.get("sizes"), said.get("resent", 0)
        if said.get("series") != series or not isinstance(sizes, list) or not isinstance(resent, int):
            raise FailedError(f"figures of {series} were expected, not {said}")
        for each in sizes:
            found.append(Measured(label, each["size"], tuple(each["rtt_s"]), dict(each["cpu_s"]), resent))
    return found
