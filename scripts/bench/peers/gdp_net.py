"""Ours on the row: a switch on each of the three in the middle, the RIB beside s2, a member at A and at B.

Place: shell; starts the commands that robots run, and makes the keys of a run.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Final

from gdp.metadata import Metadata
from gdp.stores.issue import delegate, install_delegation
from gdp.stores.keyring import CARD, ROOT_CERTIFICATE
from gdp.trust.right import Right
from peers.chain import LEFT, MIDDLE, RIGHT, Chain
from peers.baseline import READY_S, Measured, ask_end, start_end
from peers.exchange import Load
from peers.gdp_endpoint import PONG, ping_topic
from peers.process import FailedError, Started
from proxy.ring.materials import Materials

__all__ = ["ENCODINGS", "GdpNet"]

ENCODINGS: Final = ("json", "cbor", "cdr")
_MODULE: Final = "peers.gdp_endpoint"
_IFACE: Final = {LEFT: MIDDLE[0], RIGHT: MIDDLE[-1]}  # a device is called like the neighbour it leads to


class GdpNet:
    """Switches with one data plane.

    Args:
        plane: as ``gdp-switch --data-plane``.
        encodings: measured one after the other, by the same processes.
        spin_s: how long ends look for frames before they sleep.
    """

    def __init__(self, plane: str, encodings: tuple[str, ...], spin_s: float) -> None:
        self.name = f"gdp-{plane}"
        self.labels = tuple(f"{self.name} {encoding}" for encoding in encodings)
        self._plane = plane
        self._encodings = encodings
        self._spin_s = spin_s

    def measure(self, chain: Chain, load: Load) -> list[Measured]:
        """Start switches, RIB, B, A.

        Raises:
            FailedError: as ``Contender.measure``.
        """
        with ExitStack() as stack:
            files = _new_directory(chain, self.name)
            materials = Materials(chain.topology, files, metrics=False)
            switches = [stack.enter_context(self._switch(chain, materials, node)) for node in MIDDLE]
            for switch in switches:
                plane = switch.read(READY_S).get("data_plane")
                if not str(plane).startswith(self._plane):
                    raise FailedError(f"the switch took the data plane {plane} instead")
            (at,) = chain.topology.attached("rib")
            rib = ["-m", "gdp.cli.rib", "--json", "--config", str(materials.rib(at))]
            stack.enter_context(chain.start(at.switch, "rib", rib)).read(READY_S)
            between = [switch.pid for switch in switches]
            pong = stack.enter_context(self._end(chain, files, RIGHT, load, {}))
            pong.read(READY_S)
            pids = {"receiver": [pong.pid], "between": between}
            ping = stack.enter_context(self._end(chain, files, LEFT, load, pids))
            return ask_end(ping, dict(zip(self._encodings, self.labels, strict=True)))

    def _switch(self, chain: Chain, materials: Materials, node: str) -> Started:
        config = str(materials.switch(node, "auto"))
        arguments = ["-m", "gdp.cli.switch", "--json", "--data-plane", self._plane, "--config", config]
        return chain.start(node, f"{self.name}-switch", arguments)

    def _end(self, chain: Chain, files: Path, node: str, load: Load, pids: dict[str, list[int]]) -> Started:
        own = {
            "config": str(_admit_end(files, node, self._encodings)),
            "encodings": " ".join(self._encodings),
            "spin_s": str(self._spin_s),
        }
        return start_end(chain, _MODULE, node, load, own, pids)


def _new_directory(chain: Chain, name: str) -> Path:
    """Return a directory for the keys of one start."""
    starts = sum(1 for _ in chain.directory.glob(f"{name}.keys-*"))
    directory = chain.directory / f"{name}.keys-{starts}"
    directory.mkdir(mode=0o700)
    return directory


def _admit_end(files: Path, node: str, encodings: tuple[str, ...]) -> Path:
    """Let an end publish and read what it has to, and write its configuration; return the file."""
    identity = files / "nodes" / f"proxy-{node}"
    pings = [ping_topic(encoding) for encoding in encodings]
    published, read = (pings, [PONG]) if node == LEFT else ([PONG], pings)
    for topics, right in ((published, Right.PUBLISH), (read, Right.READ)):
        for topic in topics:
            given = delegate(files / "owner", identity / CARD, Metadata({"kind": "topic", "name": topic}), [right])
            install_delegation(identity, given)
    path, root = files / f"end-{node}.yaml", files / "domains" / "chain" / ROOT_CERTIFICATE
    path.write_text(f"identity: {identity}\ndomain: {{root: {root}}}\niface: {_IFACE[node]}\n", encoding="utf-8")
    return path
