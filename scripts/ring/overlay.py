"""Overlay of a run: five namespaces with a switch in each and a RIB in each domain, and its faults.

I/O. No stage waits by the clock: each begins when the one before has reported that it is ready. Every process is
supervised, so that one which dies ends the run at once.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, Literal

from gdp.errors import LocalError
from gdp.host.run_registry import Run
from lab.cores import EDGE_CORES, ROBOT_CORES, MachineCores, cores_of
from lab.credentials import OverlayCredentials
from lab.faults import Fault, FaultKind, moments
from lab.machines import Lab, OverlayNodes
from lab.process import LabProcess
from lab.supervisor import READY_S, Supervisor
from ring.faults import CUT, ROAM, roamers, text_of, victims
from ring.options import Options
from ring.traffic import ProgressReporter

_MIDDLE: Final = "nuc3"
_RIB_WORDS: Final = ("--await-iface", f"{READY_S:g}")


class Overlay:
    """The overlay of one run, from its creation; other modules start the proxies.

    ``run``: removes what is created here. Raises ``LocalError``: the kernel refuses namespaces.
    """

    def __init__(self, options: Options, run: Run, reporter: ProgressReporter) -> None:
        self.options = options
        self.topology = options.topology()
        self.robot, self.server = self.topology.attached("proxy")
        self.reporter = reporter
        self.supervisor = Supervisor()
        reporter.step(f"run {run.id}: five namespaces, keys and certificates")
        self.lab = Lab(run, self.topology, dies_with_us=not options.keep)
        self._roamers = roamers(options.faults, self.topology)
        for at in self._roamers.values():
            self.lab.namespaces.connect_device(at.switch, at.ifname, at.switch)
        self.credentials = OverlayCredentials(
            self.topology,
            run.directory,
            metrics=options.keep,
            roamers=self._roamers.values(),
            lease_s=options.lease_s,
            uplink={"data_plane": "scapy"} if options.data_plane == "scapy" else None,
        )
        self.nodes = OverlayNodes(self.lab, self.credentials)
        if options.cores:
            self.lab.cores = self._make_cores(run)
        self._planes: list[str] = []  # the data planes that the switches selected

    @property
    def settings(self) -> dict[str, object]:
        """Return the options for the JSON result, with the selected data plane and the cores of each machine."""
        cores = None if self.lab.cores is None else self.lab.cores.cores
        return {**self.options.settings(), "data_plane": ", ".join(self._planes), "cores": cores}

    def stand_up(self) -> None:
        """Start switches and RIBs; return when all are ready."""
        if self.options.pcap is not None:
            argv = ["-m", "ring.capture", str(self.options.pcap), *self.topology.neighbours(_MIDDLE)]
            self.supervisor.ready(self.lab.start(_MIDDLE, "capture", argv))
        self.reporter.step("starting a switch in each, and the RIB of each domain")
        said = self.nodes.stand_up(self.topology.nodes, self.options.data_plane, *_RIB_WORDS)
        self._planes = sorted({str(each["data_plane"]) for each in said})
        for reason in sorted({str(each["reason"]) for each in said} - {""}):
            self.reporter.step(f"data plane {', '.join(self._planes)}: {reason}")
        self.supervisor.require(*self.nodes.running.values())
        self.reporter.step(f"starting the proxies at {self.robot.switch} and {self.server.switch}")

    def start_proxy(
        self, node: str, config: Path, environment: Sequence[str] = (), *, heard: bool = True
    ) -> LabProcess:
        """Start a proxy at a switch; one that is not heard outlives this process."""
        argv = ["-m", "proxy.cli.proxy", "--config", str(config), *(["--json"] if heard else [])]
        return self.lab.start(node, "proxy", argv, environment, heard=heard)

    def inject(self, fault: Fault, *, begins: bool) -> None:
        """Begin a fault, or end it. Raises ``LocalError``: the kernel refuses."""
        namespaces, targets = self.lab.namespaces, fault.targets
        if fault.kind is CUT:
            (namespaces.cut if begins else namespaces.restore_link)(*targets)
            link = "-".join(targets)
            self.reporter.step(f"cut {link}" if begins else f"{link} is back")
        elif fault.kind is not ROAM:
            self._kill(fault, begins=begins)
        elif begins:
            who, to = targets
            home = self._roamers[who].switch
            namespaces.unplug(home, who)
            namespaces.connect_device(home, who, to)
            self.reporter.step(f"{who} moved to {to}")

    def _kill(self, kill: Fault, *, begins: bool) -> None:
        """Kill a switch, or the RIBs of a domain, or start them again."""
        role: Literal["rib", "switch"] = "rib" if kill.kind is FaultKind.KILL_RIB else "switch"
        what = kill.targets[0].replace("rib ", "rib of ")
        for node in victims(kill, self.topology):
            if begins:
                process = self.nodes.running[role, node]
                self.supervisor.release(process)
                process.kill_group()
                continue
            process = self.nodes.start(role, node, *(_RIB_WORDS if role == "rib" else ()))
            self.supervisor.expect(process, lambda _: self.reporter.step(f"{what} is back"))
        if begins:
            self.reporter.step(f"killed {what}")

    def _make_cores(self, run: Run) -> MachineCores | None:
        try:
            made = MachineCores(run, cores_of(self.topology))
        except LocalError as error:
            self.reporter.step(f"--cores has no effect: no control groups can be made here ({error})")
            return None
        text = f"the robot {ROBOT_CORES}, each edge server {EDGE_CORES}"
        self.reporter.step(f"cores by control groups: {text}")
        return made


class Injection:
    """The faults of one run, injected while a supervisor waits. Their seconds count from the object's creation."""

    def __init__(self, supervisor: Supervisor, faults: Sequence[Fault], inject: Callable[..., None]) -> None:
        self._supervisor, self._inject = supervisor, inject
        self._begun_s = time.monotonic()
        self._moments = moments(faults)
        supervisor.meanwhile = self._go_on

    def stop(self) -> list[str]:
        """Stop the injection; return, as complaints, the faults that came too late."""
        self._supervisor.meanwhile = lambda: math.inf
        return [f"{text_of(fault)} came too late: the traffic was over" for _, fault, begins in self._moments if begins]

    def _go_on(self) -> float:
        """Inject what is due; return the seconds until the next moment."""
        while self._moments and self._moments[0][0] <= time.monotonic() - self._begun_s:
            _, fault, begins = self._moments.pop(0)
            self._inject(fault, begins=begins)
        return self._moments[0][0] - (time.monotonic() - self._begun_s) if self._moments else math.inf
