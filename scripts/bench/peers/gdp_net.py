"""GDP on the row: a switch on each of the three in the middle, the RIB at s2, a member at A and at B.

I/O. Starts the commands that robots run, and makes the keys of a run.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Final

from testbed import OverlayNodes
from topologies import LEFT, MIDDLE, RIGHT

from gdp.trust.right import Right
from peers.baseline import READY_S, Measured, ask_end, start_end
from peers.chain import Chain
from peers.exchange import Load
from peers.gdp_endpoint import PONG, ping_topic
from peers.process import Started

ENCODINGS: Final = ("json", "cbor", "cdr")
_MODULE: Final = "peers.gdp_endpoint"


class GdpNet:
    """Switches with one data plane.

    Args:
        plane: as ``gdp-switch --data-plane``.
        encodings: measured one after the other, by the same processes.
        spin_s: seconds for which endpoints poll for frames before they sleep.
        path: kind of endpoint: ``library``; ``unicast`` or ``session``: a request and its response, signed or under a
            session secret.
    """

    def __init__(self, plane: str, encodings: tuple[str, ...], spin_s: float, path: str = "library") -> None:
        self.name = f"gdp-{plane}" if path == "library" else f"gdp-{plane}-{path}"
        self._path = path
        self.labels = tuple(f"{self.name} {encoding}" for encoding in encodings)
        self._plane = plane
        self._encodings = encodings
        self._spin_s = spin_s

    def measure(self, chain: Chain, load: Load) -> list[Measured]:
        """Start switches, RIB, B, A.

        Raises:
            FailedError: as ``Baseline.measure``.
        """
        with ExitStack() as stack:
            nodes = OverlayNodes(chain, MIDDLE, plane=self._plane, label=self.name)
            stack.callback(nodes.close)
            between = [switch.pid for switch in nodes.switches]
            pong = stack.enter_context(self._end(nodes, RIGHT, load, {}))
            pong.read(READY_S)
            pids = {"receiver": [pong.pid], "between": between}
            ping = stack.enter_context(self._end(nodes, LEFT, load, pids))
            return ask_end(ping, dict(zip(self._encodings, self.labels, strict=True)))

    def _end(self, nodes: OverlayNodes, node: str, load: Load, pids: dict[str, list[int]]) -> Started:
        pings = [ping_topic(encoding) for encoding in self._encodings]
        published, read = (pings, [PONG]) if node == LEFT else ([PONG], pings)
        rights = {Right.PUBLISH: published, Right.READ: read}
        if self._path in ("unicast", "session"):
            rights = {Right.CALL if node == LEFT else Right.SERVE: pings}
        own = {
            "config": str(nodes.admit_member(node, rights)),
            "encodings": " ".join(self._encodings),
            "spin_s": str(self._spin_s),
            "path": self._path,
        }
        return start_end(nodes.lab, _MODULE, node, load, own, pids)
