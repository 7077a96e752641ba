"""The row of the bench of bundles: A - s1 - s2 - s3 - B, the RIB beside s2, all switches with the plane ``kernel``.

Place: shell; makes keys and starts the commands that robots run.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from typing import Final

from bundles_endpoint import topics
from peers.chain import LEFT, MIDDLE, RIGHT, Chain
from peers.process import FailedError, Started

from gdp.metadata import Metadata
from gdp.stores.issue import delegate, install_delegation
from gdp.stores.keyring import CARD, ROOT_CERTIFICATE
from gdp.testbed.runs import Run
from gdp.trust.right import Right
from proxy.ring.materials import Materials

__all__ = ["READY_S", "Row"]

READY_S: Final = 20.0
_IFACE: Final = {LEFT: MIDDLE[0], RIGHT: MIDDLE[-1]}  # a device is called like the neighbour it leads to


class Row:
    """The row with its switches and RIB running; a context manager that ends them.

    Args:
        run: of which the namespaces are.
        count: topics that A may publish and B may read.

    Raises:
        LocalError: the kernel refuses.
        FailedError: a process did not come up.
    """

    def __init__(self, run: Run, count: int, *, mtu: int) -> None:
        self._undo = ExitStack()
        self._chain = Chain(mtu, run)
        self._files = run.directory / "keys"
        self._files.mkdir(mode=0o700)
        materials = Materials(self._chain.topology, self._files, metrics=False)
        for node in _IFACE:
            self._admit(node, topics(count))
        with ExitStack() as undo:
            for node in MIDDLE:
                config = str(materials.switch(node, "auto"))
                argv = ["-m", "gdp.cli.switch", "--json", "--data-plane", "kernel", "--config", config]
                took = undo.enter_context(self._chain.start(node, "switch", argv)).read(READY_S).get("data_plane")
                if not str(took).startswith("kernel"):
                    raise FailedError(f"the switch took the data plane {took} instead")
            (at,) = self._chain.topology.attached("rib")
            rib = ["-m", "gdp.cli.rib", "--json", "--config", str(materials.rib(at))]
            undo.enter_context(self._chain.start(at.switch, "rib", rib)).read(READY_S)
            self._undo = undo.pop_all()

    def __enter__(self) -> Row:
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()

    def end(self, what: str, **settings: str | float) -> Started:
        """Start an end of ``bundles_endpoint.py``: ``send`` at A, ``read`` at B."""
        node = LEFT if what == "send" else RIGHT
        told = json.dumps({"config": str(self._files / f"end-{node}.yaml"), **settings})
        return self._chain.start(node, what, ["-m", "bundles_endpoint", what, told])

    def _admit(self, node: str, names: list[str]) -> None:
        """Let an end publish or read the topics, and write its configuration."""
        identity = self._files / "nodes" / f"proxy-{node}"
        right = Right.PUBLISH if node == LEFT else Right.READ
        for name in names:
            metadata = Metadata({"kind": "topic", "name": name})
            install_delegation(identity, delegate(self._files / "owner", identity / CARD, metadata, [right]))
        root = self._files / "domains" / "chain" / ROOT_CERTIFICATE
        text = f"identity: {identity}\ndomain: {{root: {root}}}\niface: {_IFACE[node]}\n"
        (self._files / f"end-{node}.yaml").write_text(text, encoding="utf-8")
