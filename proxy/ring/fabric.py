"""What every run stands on: five namespaces, with a switch in each and a RIB in each domain.

Place: shell. Nothing is waited for by the clock: every stage begins when the one before has said that it is ready, and
every process is watched, so that one which dies ends the run at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from gdp.testbed.namespaces import Namespaces
from gdp.testbed.runs import Run
from proxy.ring.child import Child
from proxy.ring.children import Children
from proxy.ring.materials import Materials
from proxy.ring.options import Options
from proxy.ring.progress import Teller

__all__ = ["Fabric"]

_MIDDLE: Final = "nuc3"


class Fabric:
    """The overlay of one run, from its laying on; the ends are others' work.

    Args:
        options: what was asked for.
        run: takes down what is made here, whoever asks it to.
        teller: hears of progress.

    Raises:
        LocalError: the kernel refuses namespaces.
    """

    def __init__(self, options: Options, run: Run, teller: Teller) -> None:
        self.options = options
        self.topology = options.topology()
        self.robot, self.server = self.topology.attached("proxy")
        self.teller = teller
        teller.step(f"run {run.id}: five namespaces, keys and certificates")
        self.namespaces = Namespaces(self.topology, run)
        self.materials = Materials(self.topology, run.directory, metrics=options.keep)
        self.children = Children(run, kept=options.keep)
        self.switches: dict[str, Child] = {}
        self._planes: list[str] = []  # what the switches took

    @property
    def settings(self) -> dict[str, object]:
        """Return the options as the JSON result states them, with the data plane that was taken."""
        return {**self.options.settings(), "data_plane": ", ".join(self._planes)}

    async def stand_up(self) -> None:
        """Start switches and RIBs; return when all are ready.

        Raises:
            ChildError: a process failed.
        """
        if self.options.pcap is not None:
            ifaces = [f"--iface={link.other(_MIDDLE)}" for link in self.topology.links_of(_MIDDLE)]
            capture = self.start(_MIDDLE, "capture", ["-m", "gdp.ports.capture", *ifaces, str(self.options.pcap)])
            await self.children.ready([capture])
        self.teller.step("starting a switch in each")
        for node in self.topology.nodes:
            config = self.materials.switch(node, self.options.data_plane)
            argv = ["-m", "gdp.cli.switch", "--config", str(config), "--json"]
            self.switches[node] = self.start(node, "switch", argv)
        said = await self.children.ready(list(self.switches.values()))
        self._planes = sorted({each.text("data_plane") for each in said})
        for reason in sorted({each.text("reason") for each in said} - {""}):
            self.teller.step(f"data plane {', '.join(self._planes)}: {reason}")
        self.teller.step("starting the RIB of each domain")
        configs = {at.switch: self.materials.rib(at) for at in self.topology.attached("rib")}
        await self.children.ready(
            [
                self.start(node, "rib", ["-m", "gdp.cli.rib", "--config", str(config), "--json"])
                for node, config in configs.items()
            ]
        )
        self.teller.step(f"starting the proxies at {self.robot.switch} and {self.server.switch}")

    def start(
        self,
        node: str,
        role: str,
        arguments: Sequence[str],
        *,
        heard: bool = True,
        environment: Mapping[str, str] | None = None,
    ) -> Child:
        """Start Python with these arguments in the namespace of a switch; ``environment``: beside that of ours."""
        return self.children.start_in(self.namespaces, node, role, arguments, heard=heard, environment=environment)

    def forget(self) -> None:
        """Close our ends of the processes; they are left as they are."""
        self.children.forget()
