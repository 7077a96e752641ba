"""Overlay of a run: five namespaces with a switch in each and a RIB in each domain, and its faults.

I/O. No stage waits by the clock: each begins when the one before has reported that it is ready. Every process is
supervised, so that one which dies ends the run at once.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.host.run_registry import Run
from lab.children import READY_S, Child, Children, cancel
from lab.credentials import OverlayCredentials
from lab.namespaces import Namespaces
from ring.cores import EDGE_CORES, ROBOT_CORES, MachineCores, cores_of
from ring.faults import Cut, Fault, Kill, Roam, roamers
from ring.options import Options
from ring.progress import ProgressReporter

_MIDDLE: Final = "nuc3"


class Overlay:
    """The overlay of one run, from its creation; other modules start the proxies.

    A fault that the kernel refuses raises ``LocalError``. ``run``: removes what is created here. Raises ``LocalError``:
    the kernel refuses namespaces.
    """

    def __init__(self, options: Options, run: Run, reporter: ProgressReporter) -> None:
        self.options = options
        self.topology = options.topology()
        self.robot, self.server = self.topology.attached("proxy")
        self.reporter = reporter
        reporter.step(f"run {run.id}: five namespaces, keys and certificates")
        self.namespaces = Namespaces(self.topology, run)
        roaming = roamers(options.faults, self.topology)
        for at in roaming:
            self.namespaces.connect_device(at.switch, at.ifname, at.switch)
        self.credentials = OverlayCredentials(
            self.topology,
            run.directory,
            metrics=options.keep,
            roamers=roaming,
            lease_s=options.lease_s,
            uplink={"data_plane": "scapy"} if options.data_plane == "scapy" else None,
        )
        self._cores = self._make_cores(run) if options.cores else None
        self.children = Children(run, kept=options.keep, started=None if self._cores is None else self._cores.add)
        self.start = partial(self.children.start_in, self.namespaces)
        self.switches: dict[str, Child] = {}
        self._ribs: dict[str, Child] = {}
        self._restarts = 0
        self._planes: list[str] = []  # the data planes that the switches selected

    @property
    def settings(self) -> dict[str, object]:
        """Return the options for the JSON result, with the selected data plane and the cores of each machine."""
        cores = None if self._cores is None else self._cores.cores
        return {**self.options.settings(), "data_plane": ", ".join(self._planes), "cores": cores}

    async def stand_up(self) -> None:
        """Start switches and RIBs; return when all are ready."""
        if self.options.pcap is not None:
            ifaces = [f"--iface={link.other(_MIDDLE)}" for link in self.topology.links_of(_MIDDLE)]
            capture = self.start(_MIDDLE, "capture", ["-m", "gdp.ports.capture", *ifaces, str(self.options.pcap)])
            await self.children.ready([capture])
        self.reporter.step("starting a switch in each")
        for node in self.topology.nodes:
            config = self.credentials.switch(node, self.options.data_plane)
            self.switches[node] = self._start_switch(node, config)
        said = await self.children.ready(list(self.switches.values()))
        self._planes = sorted({each.text("data_plane") for each in said})
        for reason in sorted({each.text("reason") for each in said} - {""}):
            self.reporter.step(f"data plane {', '.join(self._planes)}: {reason}")
        self.reporter.step("starting the RIB of each domain")
        configs = {at.switch: self.credentials.rib(at) for at in self.topology.attached("rib")}
        self._ribs = {node: self._start_rib(node, config) for node, config in configs.items()}
        await self.children.ready(list(self._ribs.values()))
        self.reporter.step(f"starting the proxies at {self.robot.switch} and {self.server.switch}")

    async def cut(self, cut: Cut) -> None:
        """Take a link down."""
        await asyncio.to_thread(self.namespaces.cut, cut.a, cut.b)

    async def heal(self, cut: Cut) -> None:
        """Bring a link back."""
        await asyncio.to_thread(self.namespaces.restore_link, cut.a, cut.b)

    async def kill(self, kill: Kill) -> None:
        """Kill a switch, or the RIBs of a domain."""
        running = self.switches if kill.role == "switch" else self._ribs
        for node in kill.victims(self.topology):
            await self.children.kill(running[node])

    async def restart(self, kill: Kill) -> None:
        """Restart a killed process; return when it is ready."""
        self._restarts += 1
        running, start = (self.switches, self._start_switch) if kill.role == "switch" else (self._ribs, self._start_rib)
        for node in kill.victims(self.topology):
            child = running[node] = start(node, self.credentials.file(kill.role, node), f"restart-{self._restarts}-")
            await self.children.ready([child])

    async def roam(self, roam: Roam) -> None:
        """Move a proxy's cable to another switch."""
        home = roam.proxy(self.topology).switch
        await asyncio.to_thread(self.namespaces.unplug, home, roam.who)
        await asyncio.to_thread(self.namespaces.connect_device, home, roam.who, roam.to)

    def _make_cores(self, run: Run) -> MachineCores | None:
        try:
            made = MachineCores(run, cores_of(self.topology))
        except LocalError as error:
            self.reporter.step(f"--cores has no effect: no control groups can be made here ({error})")
            return None
        text = f"the robot {ROBOT_CORES}, each edge server {EDGE_CORES}"
        self.reporter.step(f"cores by control groups: {text}")
        return made

    def _start_switch(self, node: str, config: Path, prefix: str = "") -> Child:
        return self.start(node, f"{prefix}switch", ["-m", "gdp.cli.switch", "--config", str(config), "--json"])

    def _start_rib(self, node: str, config: Path, prefix: str = "") -> Child:
        argv = ["-m", "gdp.cli.rib", "--config", str(config), "--json", "--await-iface", f"{READY_S:g}"]
        return self.start(node, f"{prefix}rib", argv)


class Injection:
    """The faults of one run. Their seconds count from the creation of this object."""

    def __init__(self, injector: Overlay, faults: Sequence[Fault], reporter: ProgressReporter) -> None:
        self._injector = injector
        self._reporter = reporter
        self._begun: set[Fault] = set()
        self._tasks = {fault: asyncio.ensure_future(self._inject(fault)) for fault in faults}

    async def stop(self) -> None:
        """Stop the injection."""
        await cancel(*self._tasks.values())

    def complaints(self) -> list[str]:
        """Return, after the stop, the faults that came too late."""
        for task in self._tasks.values():
            if not task.cancelled():
                task.result()
        return [f"{fault} came too late: the traffic was over" for fault in self._tasks if fault not in self._begun]

    async def _inject(self, fault: Fault) -> None:
        injector = self._injector
        if isinstance(fault, Cut):
            link = f"{fault.a}-{fault.b}"
            await self._at(fault.after_s, lambda: injector.cut(fault), f"cut {link}")
            self._begun.add(fault)
            await self._at(fault.until_s, lambda: injector.heal(fault), f"{link} is back", fault.after_s)
        elif isinstance(fault, Kill):
            process = f"{fault.role} of {fault.of}" if fault.role == "rib" else f"{fault.role} {fault.of}"
            await self._at(fault.after_s, lambda: injector.kill(fault), f"killed {process}")
            self._begun.add(fault)
            await self._at(fault.until_s, lambda: injector.restart(fault), f"{process} is back", fault.after_s)
        else:
            await self._at(fault.after_s, lambda: injector.roam(fault), f"{fault.who} moved to {fault.to}")
            self._begun.add(fault)

    async def _at(
        self, at_s: float | None, act: Callable[[], Awaitable[None]], done: str, passed_s: float = 0.0
    ) -> None:
        if at_s is not None:
            await asyncio.sleep(at_s - passed_s)
            await act()
            self._reporter.step(done)
