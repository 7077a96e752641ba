"""The row of the bench of priorities: A and a second sender C at the first of three switches, B behind the last.

Place: shell; makes namespaces, keys and processes through ``gdp.testbed`` and the commands that robots run.
::

    a --.
        s1 -- s2 -- s3 -- b           the RIB beside s2; what is shaped is s1's way out to s2
    c --'
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from typing import Final

from peers.process import FailedError, Started
from priority_endpoint import CONTROL, IMAGES
from pyroute2 import IPRoute

from gdp.metadata import Metadata
from gdp.stores.issue import delegate, install_delegation
from gdp.stores.keyring import CARD, ROOT_CERTIFICATE
from gdp.testbed import netns_files
from gdp.testbed.namespaces import Namespaces
from gdp.testbed.runs import Run
from gdp.testbed.topology import Attachment, DomainPlan, Link, Topology
from gdp.trust.right import Right
from proxy.ring.materials import Materials

__all__ = ["MTU", "SHAPED_BITS_S", "Row"]

MTU: Final = 1_500
SHAPED_BITS_S: Final = 100_000_000
_BURST_BYTES: Final = 2 * (MTU + 14)  # tbf must be able to send one frame; more would let a flood run ahead
_SWITCHES: Final = ("s1", "s2", "s3")
_ENDS: Final = {"a": "s1", "c": "s1", "b": "s3"}  # a device is called like the neighbour it leads to
_TOPOLOGY: Final = Topology(
    links=(
        *(Link(end, at, mtu=MTU) for end, at in _ENDS.items()),
        Link("s1", "s2", mtu=MTU),
        Link("s2", "s3", mtu=MTU),
    ),
    domains=(DomainPlan("row", ("a", "c", *_SWITCHES, "b")),),
    attachments=(Attachment("s2", "rib", "rib"), *(Attachment(end, "proxy", "end") for end in _ENDS)),
)
_READY_S: Final = 20.0
_PRIORITIES: Final = {"switch": 3, "rib": 3, "tick": 2, "read": 2, "flood": 1}


class Row:
    """The row with its switches and RIB running; a context manager that ends them.

    Args:
        run: of which the namespaces are.
        plane: as ``gdp-switch --data-plane``.
        shaped: whether s1's way to s2 carries no more than ``SHAPED_BITS_S``, urgent frames first.
        realtime: under SCHED_FIFO, switches before the ticking and the reading end, and these before the other one: a
            flood never sleeps, so equals would starve.

    Raises:
        LocalError: the kernel refuses.
        FailedError: a process did not come up.
    """

    def __init__(self, run: Run, plane: str, *, shaped: bool, realtime: bool) -> None:
        self._is_realtime = realtime
        self._run = run
        self._undo = ExitStack()
        self._spaces = Namespaces(_TOPOLOGY, run)
        if shaped:
            netns_files.inside(self._spaces.path("s1"), partial(_shape, "s2"))
        self._files = run.directory / "keys"
        self._files.mkdir(mode=0o700)
        materials = Materials(_TOPOLOGY, self._files, metrics=False)
        for end in _ENDS:
            self._admit(end)
        with ExitStack() as undo:
            for node in _SWITCHES:
                config = str(materials.switch(node, "auto"))
                argv = ["-m", "gdp.cli.switch", "--json", "--data-plane", plane, "--config", config]
                switch = undo.enter_context(self._start(node, "switch", argv))
                took = str(switch.read(_READY_S).get("data_plane"))
                if not took.startswith(plane):
                    raise FailedError(f"the switch took the data plane {took} instead")
            (at,) = _TOPOLOGY.attached("rib")
            rib = ["-m", "gdp.cli.rib", "--json", "--config", str(materials.rib(at))]
            undo.enter_context(self._start(at.switch, "rib", rib)).read(_READY_S)
            self._undo = undo.pop_all()

    def __enter__(self) -> Row:
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()

    def end(self, node: str, what: str, **settings: str | float) -> Started:
        """Start an end of ``priority_endpoint.py`` on a machine."""
        told = json.dumps({"config": str(self._config(node)), **settings})
        return self._start(node, what, ["-m", "priority_endpoint", what, told])

    def _start(self, node: str, what: str, arguments: Sequence[str]) -> Started:
        started = Started(self._run, f"{what} at {node}", partial(self._spaces.command, node), arguments)
        if self._is_realtime:
            os.sched_setscheduler(started.pid, os.SCHED_FIFO, os.sched_param(_PRIORITIES[what]))
        return started

    def _config(self, node: str) -> str:
        return str(self._files / f"end-{node}.yaml")

    def _admit(self, node: str) -> None:
        """Let an end publish or read both topics, and write its configuration."""
        identity = self._files / "nodes" / f"proxy-{node}"
        right = Right.READ if node == "b" else Right.PUBLISH
        for topic in (CONTROL, IMAGES):
            metadata = Metadata({"kind": "topic", "name": topic})
            install_delegation(identity, delegate(self._files / "owner", identity / CARD, metadata, [right]))
        root = self._files / "domains" / "row" / ROOT_CERTIFICATE
        text = f"identity: {identity}\ndomain: {{root: {root}}}\niface: {_ENDS[node]}\n"
        (self._files / f"end-{node}.yaml").write_text(text, encoding="utf-8")


def _shape(device: str) -> None:
    """Make a device the narrow place of the row: a token bucket, and in it a queue that honours priorities.

    That is ``pfifo_fast``, three bands by priority as ``prio`` has them, because every kernel has it.
    """
    with IPRoute() as here:
        (index,) = here.link_lookup(ifname=device)
        here.tc("add", "tbf", index, 0x10000, rate=SHAPED_BITS_S // 8, burst=_BURST_BYTES, limit=1 << 20)
        here.tc("add", "pfifo_fast", index, 0x20000, parent=0x10001)
