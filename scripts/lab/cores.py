"""Processor time of the ring's machines: two cores' worth for the robot, and four for each edge server.

I/O. A group for each machine has a weight, by which busy machines share the processors, and a bound of so many cores.
The run's record names each group before it is made, so that the run's end or the next start removes it.
"""

from __future__ import annotations

from typing import Final

from gdp.errors import LocalError
from gdp.host.cgroups import Cgroup
from gdp.host.run_registry import Run
from lab.topology import Topology

ROBOT_CORES: Final = 2
EDGE_CORES: Final = 4


def cores_of(topology: Topology) -> dict[str, int]:
    """Return the cores of each machine; the robot's proxy is the first one."""
    robot, *_ = topology.attached("proxy")
    return {node: ROBOT_CORES if node == robot.switch else EDGE_CORES for node in topology.nodes}


class MachineCores:
    """Control groups of the machines of one run.

    ``cores``: by machine. Raises ``LocalError``: this system permits no such groups; none is left.
    """

    def __init__(self, run: Run, cores: dict[str, int]) -> None:
        self.cores = cores
        self._groups: dict[str, Cgroup] = {}
        try:
            for node, count in cores.items():
                group = self._groups[node] = Cgroup(f"gdp-{run.id}-{node}")
                run.plan_cgroup(group.name)
                group.make()
                group.share_cpu(count)
                group.limit_cpu(count)
        except LocalError:
            for group in self._groups.values():
                group.remove()
            raise

    def add(self, node: str, pid: int) -> None:
        """Put a process, and those that it starts later, into the group of a machine."""
        self._groups[node].add(pid)
