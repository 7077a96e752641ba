"""Plan of a live run, as data: the graphs of both sides, the names that cross, and the amount of traffic. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from lab.credentials import Carried, Yaml
from lab.dds import ros_environment
from proxy.config.config import Encoding
from proxy.serial.channel import RosVersion
from ring.nodes.content import LAMP, LAMP_TYPE, TALKS
from ring.options import Live

MASTER_PORT: Final = 11_311
AUTHOR: Final = "ring"
_DOMAINS: Final = 100  # above that, a domain's ports are in Linux's ephemeral range


def carried_in(encoding: Encoding) -> tuple[Carried, ...]:
    """Return what the proxies carry; reliability and durability follow from the nodes' QoS."""
    make = partial(Carried, options={"encoding": encoding}, author=AUTHOR)
    return (*(make(talk.topic, talk.type_name) for talk in TALKS), make(LAMP, LAMP_TYPE, "service"))


@dataclass(frozen=True, slots=True)
class Graph:
    """The ROS graph of one side, alone in its network namespace. ``domain``: of ROS 2."""

    ros: RosVersion
    domain: int

    def to_yaml(self) -> Yaml:
        """Return the ``ros`` section of ``proxy.yaml``."""
        if self.ros == 1:
            return {"endpoint": "ros1", "master": self._master}
        return {"endpoint": "ros2", "domain": self.domain}

    def environment(self, folder: Path) -> list[str]:
        """Return the environment of its nodes and its proxy, as ``KEY=value``.

        ``folder``: for a profile, and for ROS's logs.
        """
        ros1 = [f"ROS_MASTER_URI={self._master}", "ROS_HOSTNAME=127.0.0.1"]
        return [
            *(ros1 if self.ros == 1 else ros_environment(folder, self.domain)),
            f"ROS_LOG_DIR={folder / 'ros-logs'}",
        ]

    @property
    def _master(self) -> str:
        return f"http://127.0.0.1:{MASTER_PORT}"


def graphs_of(live: Live, run: str) -> tuple[Graph, Graph]:
    """Return the robot's graph and the server's; ``run`` is an id in hex, from which their domains are derived."""
    domain = 1 + int(run, 16) % _DOMAINS
    robot: RosVersion = 2 if live == "ros2" else 1
    server: RosVersion = 1 if live == "ros1" else 2
    return Graph(robot, domain), Graph(server, domain % _DOMAINS + 1)


def paces(camera_hz: float) -> dict[str, float]:
    """Return the messages a second of each talker."""
    return {talk.node: talk.hz for talk in TALKS} | {"camera": camera_hz}


def messages_in(seconds: float, hz: float) -> int:
    """Return the number of messages that a talker publishes, or of calls."""
    return max(round(hz * seconds), 1)
