"""Machines of ``fog`` that find a tag's pose, and the robot that calls them: the stage of figures 4 and 9.

I/O. ``fog_demo.cluster`` makes the machines, and the supervisor replaces them.
::

    robot (proxy, switch, RIB) === uplink === gateway --+-- m1       gateway: a switch of its own, or one of the
                                                        +-- m2       machines, to which the uplink then leads
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

import bench_path  # noqa: F401 - finds the packages of scripts
from frames import TYPE

from fog.providers.local.machine_handle import find
from fog.providers.local.netlinks import MACHINE_DEVICE, UP
from fog_demo.cluster import Cluster
from gdp.host import netns_files
from lab.namespaces import received
from lab.process import LabProcess

SERVICE: Final = "/tag"
_HERE: Final = Path(__file__).resolve().parent
_LAUNCH_FILE: Final = """\
from fog import FogCluster, LaunchDescription, Node, SpotMachine

def generate_launch_description():
    FogCluster(
        name={name!r},
        cloud_nodes=[Node(package="experiments", executable="replica", arguments={arguments}, additional_env={path})],
        deployments=[SpotMachine(hardware="cpu:1")],
        replicas={replicas},
        services={services},
    )
    return LaunchDescription([])
"""


class TagCluster(Cluster):
    """Machines that serve; each service has as many of its own.

    ``replicas``: machines of each service. ``timeout_s``: after which a call has failed.
    """

    def __init__(self, services: Sequence[str], replicas: int, gateway: str, timeout_s: float) -> None:
        launch_files = [
            _LAUNCH_FILE.format(
                name=each.strip("/"),
                arguments=["tag", json.dumps({"services": each})],
                path={"PYTHONPATH": f"{_HERE}:{_HERE.parent}"},
                replicas=replicas,
                services={each: {"type": TYPE, "encoding": "cdr", "timeout_s": timeout_s}},
            )
            for each in services
        ]
        super().__init__(launch_files, replicas * len(services), gateway)

    def client(self, place: str, role: str, **settings: object) -> LabProcess:
        """Start a client at the robot: a role of ``robot.py`` and its settings."""
        del place  # there is one robot
        return self.start(role, [str(_HERE / "robot.py"), role, json.dumps(settings)])

    def received_bytes(self) -> tuple[int, int, int]:
        """Return the bytes that have arrived over the robot's uplink: at its far end, at the robot, at all machines.

        A frame that the kernel forwards bypasses the counter of its sender.
        """
        machines = [find(self._runs, each.id) for each in self.machines()]
        far = netns_files.inside(machines[0].gateway, partial(_bytes, UP))
        near = self.inside(partial(_bytes, self._site.uplink))
        at_machines = (netns_files.inside(each.netns_path, partial(_bytes, MACHINE_DEVICE, UP)) for each in machines)
        return far, near, sum(at_machines)


def _bytes(*devices: str) -> int:
    return sum(received(devices, "rx_bytes").values())
