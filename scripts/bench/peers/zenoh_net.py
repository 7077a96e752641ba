"""Zenoh on the row: a router on each of the three in the middle, a client at either end; mutual TLS or plain TCP.

I/O. Starts processes. Every hop is a link of its own, so a message is encrypted and decrypted at each.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Final

from topologies import LEFT, MIDDLE, RIGHT

from peers.baseline import READY_S, Measured, ask_end, start_end
from peers.certificates import make_certificates
from peers.chain import NODES, Chain, address
from peers.exchange import Load
from peers.jsonl import EndSettings
from peers.process import Started

_MODULE: Final = "peers.zenoh_endpoint"
_PORT: Final = 7447


class ZenohNet:
    """Zenoh, secured or not."""

    def __init__(self, *, secured: bool) -> None:
        self._scheme = "tls" if secured else "tcp"
        self.name = "zenoh-mtls" if secured else "zenoh-tcp"
        self.labels = (self.name,)

    def measure(self, chain: Chain, load: Load) -> list[Measured]:
        """Start routers from the left, then B, then A.

        Raises:
            FailedError: as ``Baseline.measure``.
        """
        with ExitStack() as stack:
            routers = []
            for before, node in zip(NODES, MIDDLE, strict=False):
                own = {"listen": f"{self._scheme}/0.0.0.0:{_PORT}", **self._identity(chain, node)}
                if before in MIDDLE:
                    own["connect"] = self._at(before, node)
                routers.append(stack.enter_context(_router(chain, node, own)))
                routers[-1].read(READY_S)
            pids = {"between": [each.pid for each in routers]}
            pong = stack.enter_context(self._end(chain, RIGHT, MIDDLE[-1], load, {}))
            pong.read(READY_S)
            ping = stack.enter_context(self._end(chain, LEFT, MIDDLE[0], load, {"receiver": [pong.pid], **pids}))
            return ask_end(ping, {"zenoh": self.name})

    def _end(self, chain: Chain, node: str, router: str, load: Load, pids: dict[str, list[int]]) -> Started:
        own = {"connect": self._at(router, node), **self._identity(chain, node)}
        return start_end(chain, _MODULE, node, load, own, pids)

    def _at(self, router: str, seen_from: str) -> str:
        return f"{self._scheme}/{address(router, seen_from)}:{_PORT}"

    def _identity(self, chain: Chain, node: str) -> dict[str, str]:
        if self._scheme != "tls":
            return {}
        directory = chain.directory / "tls"
        if not directory.exists():
            links = chain.topology.links
            hosts = {host: [address(host, link.other(host)) for link in links if host in link.ends()] for host in NODES}
            make_certificates(directory, hosts)
        return {"certificate": str(directory / node)}


def _router(chain: Chain, node: str, own: dict[str, str]) -> Started:
    settings = EndSettings("router", Load((), 0), {}, own)
    return chain.start(node, "zenoh_router", ["-m", _MODULE, settings.to_argument()])
