"""Synthetic nodes for the live view: control sockets of a network that does not exist, with figures that move.

I/O. One thread serves all sockets, one in each folder, as nodes do. The figures follow from the time, so that two
readers agree.
"""

from __future__ import annotations

import contextlib
import hashlib
import select
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

from gdp.management.control_socket import CONTROL_SOCKET, ControlHandlers, ControlServer
from gdp.state.snapshot import ID_CHARS

__all__ = ["SyntheticNetwork", "serve_network"]

_DOMAINS: Final = ("campus", "backbone", "cloud", "factory")
_TOPICS: Final = ("/camera/image", "/scan", "/odom", "/tf", "/cmd_vel", "/points", "/imu", "/joint_states")
_TYPES: Final = (
    "sensor_msgs/msg/Image", "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage",
    "geometry_msgs/msg/Twist", "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu", "sensor_msgs/msg/JointState",
)  # fmt: skip


def _id(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:ID_CHARS]


@dataclass(slots=True)
class SyntheticNetwork:
    """A ring of switches with chords, a RIB for each domain, and proxies.

    Args:
        switches: at least 3.
        proxies: spread over the switches.
        names: of topics and a few services, spread over the proxies.
        is_ring: without chords, as the ring of the tutorial.
    """

    switches: int
    proxies: int
    names: int
    is_ring: bool = False
    begun_s: float = field(default_factory=time.monotonic)
    stopped: set[str] = field(default_factory=set)  # labels of nodes whose sockets are closed
    labels: dict[str, str] = field(default_factory=dict)  # shown in place of the first label
    _pairs: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        n = self.switches
        chords = () if self.is_ring else ((each, (each + n // 3) % n) for each in range(0, n, 5))
        self._pairs = [*((each, (each + 1) % n) for each in range(n)), *chords]

    @property
    def domains(self) -> int:
        """Return the number of domains."""
        return min(len(_DOMAINS), max(self.switches // 2, 1))

    def rename(self, node: str, label: str) -> None:
        """Show another label of a node."""
        self.labels[node] = label

    def snapshots(self) -> dict[str, ControlHandlers]:
        """Return the handlers of every node by its label."""
        every = {f"switch{each}": partial(self.switch, each) for each in range(self.switches)}
        every |= {f"rib{each}": partial(self.rib, each) for each in range(self.domains)}
        every |= {f"robot{each}": partial(self.proxy, each) for each in range(self.proxies)}
        return {
            label: ControlHandlers(reload=lambda: None, status=dict, drain=lambda: None, snapshot=snapshot)
            for label, snapshot in every.items()
        }

    def switch(self, at: int) -> Mapping[str, object]:
        """Return the snapshot of a switch."""
        ribs = [each for each in range(self.domains) if self._home_of_rib(each) == at]
        here = range(at, self.proxies, self.switches)
        others = [b if a == at else a for a, b in self._pairs if at in (a, b)]
        links = [self._link(f"switch{at}", f"switch{each}", "switch", each) for each in others]
        links += [self._link(f"switch{at}", f"rib{each}", "rib", at) for each in ribs]
        links += [self._link(f"switch{at}", f"robot{each}", "proxy", at) for each in here]
        names = [[_id(f"name{name}"), _id(f"robot{each}"), "publish"] for each in here for name in self._names_of(each)]
        return {
            **self._common(f"switch{at}", "switch", at),
            "links": links,
            "names": names,
            "trees": self._trees(at) if at < 4 or self.is_ring else [],
            "drops": {"no-route": int(self._age_s() / 3)} if at == 1 else {},
            "rib": _id(f"rib{self._domain(at)}"),
            "left_out": 0,
        }

    def rib(self, at: int) -> Mapping[str, object]:
        """Return the snapshot of a RIB."""
        home = self._home_of_rib(at)
        return {
            **self._common(f"rib{at}", "rib", home),
            "switch": _id(f"switch{home}"),
            "routes": self.names,
            "watches": 4,
        }

    def proxy(self, at: int) -> Mapping[str, object]:
        """Return the snapshot of a proxy; the first one calls a service of three replicas."""
        names = [[_id(f"name{name}"), "publish", ""] for name in self._names_of(at)]
        flows: list[dict[str, object]] = [
            {
                "name": _id(f"name{name}"),
                "local": f"/robot{at}{_TOPICS[number % len(_TOPICS)]}" + (f"_{number}" if number >= 8 else ""),
                "type": _TYPES[number % len(_TYPES)],
                "kind": "topic",
                "is_exposed": True,
            }
            for number, name in enumerate(self._names_of(at))
        ]
        sent = {_id(f"name{name}"): self._messages(name) for name in self._names_of(at)[:4]}
        reads = self._read_by(at)
        names += [[_id(f"name{name}"), "read", ""] for name in reads]
        service = _id("planner")
        servers = range(1, min(4, self.proxies))
        if at in servers:
            names.append([service, "serve", ""])
            flows.append({"name": service, "local": "/plan", "type": "nav_msgs/srv/GetPlan", "kind": "service"})
        if at == 0:
            names.append([service, "call", ""])
            first = [
                {"id": _id(f"robot{each}"), "is_there": True, "first": int(self._age_s() * (4 - each))}
                for each in servers
            ]
            flows.append(
                {
                    "name": service,
                    "local": "/plan",
                    "type": "nav_msgs/srv/GetPlan",
                    "kind": "service",
                    "servers": first,
                }
            )
        return {
            **self._common(f"robot{at}", "proxy", at % self.switches),
            "switch": _id(f"switch{at % self.switches}"),
            "names": names,
            "sent": sent,
            "received": {},
            "flows": flows,
            "messages": {"out": int(self._age_s() * 90), "in": int(self._age_s() * 20)},
        }

    def _age_s(self) -> float:
        return time.monotonic() - self.begun_s + 60.0

    def _domain(self, switch: int) -> int:
        return switch * self.domains // self.switches

    def _home_of_rib(self, at: int) -> int:
        return next(each for each in range(self.switches) if self._domain(each) == at)

    def _names_of(self, proxy: int) -> range:
        return range(proxy, self.names, self.proxies)

    def _read_by(self, proxy: int) -> list[int]:
        """Return the names of the robot before that a proxy reads."""
        before = (proxy - 1) % self.proxies
        return list(self._names_of(before))[:2] if before != proxy else []

    def _messages(self, name: int) -> dict[str, int]:
        return {"messages": int(self._age_s() * (5 + name % 30)), "readers": 1}

    def _trees(self, at: int) -> list[list[object]]:
        """Return the part of the tree of the first names: from robot 0 round the ring to robot 1's switch."""
        trees: list[list[object]] = []
        if self.proxies < 4:
            return trees
        plan = [_id("planner"), _id("robot0"), 1]
        if at == 0:
            trees.append([*plan, _id("robot0"), [_id("switch1")]])
        elif at < 4:
            next_switch = [_id(f"switch{at + 1}")] if at < 3 else []
            trees.append([*plan, _id(f"switch{at - 1}"), [_id(f"robot{at}"), *next_switch]])
        for name in list(self._names_of(0))[:2]:
            row = [_id(f"name{name}"), _id("robot0"), 1]
            if at == 0:
                trees.append([*row, _id("robot0"), [_id("switch1")]])
            elif at == 1:
                trees.append([*row, _id("switch0"), [_id("robot1")]])
        return trees

    def _common(self, label: str, role: str, switch: int) -> dict[str, object]:
        domain = _DOMAINS[self._domain(switch)]
        return {
            "role": role,
            "id": _id(label),
            "label": self.labels.get(label, label),
            "domain": _id(domain),
            "domain_label": domain,
            "uptime_s": round(self._age_s(), 1),
            "frames": {"in": int(self._age_s() * 100), "out": int(self._age_s() * 100)},
            "drops": {},
            "waiting": [],
        }

    def _link(self, label: str, other: str, role: str, switch: int) -> dict[str, object]:
        weight = int(_id(min(label, other) + max(label, other))[:4], 16) % 97
        bytes_one_way = int(self._age_s() * weight**3 * 3)
        is_first = label < other
        return {
            "port": f"to-{other}",
            "to": _id(other),
            "label": other,
            "role": role,
            "domain": _id(_DOMAINS[self._domain(switch)]),
            "rtt_ms": 0.2 + weight / 8 if role == "switch" else 0.1,
            "loss": 0.012 if weight == 13 else 0.0,
            "cost": 10,
            "mtu": 1_500,
            "bytes_in": bytes_one_way // 9 if is_first else bytes_one_way,
            "bytes_out": bytes_one_way if is_first else bytes_one_way // 9,
        }


@contextlib.contextmanager
def serve_network(network: SyntheticNetwork, folder: Path) -> Iterator[list[Path]]:
    """Serve the control sockets of a network while within; yield the folder of each node.

    A label in ``network.stopped`` gets its socket closed.
    """
    servers: dict[str, ControlServer] = {}
    for label, handlers in network.snapshots().items():
        (folder / label).mkdir()
        servers[label] = ControlServer(folder / label / CONTROL_SOCKET, handlers)
    ended, waking = socket.socketpair()
    poll = select.poll()
    by_fd = {server.fileno(): label for label, server in servers.items()}
    for fd in (*by_fd, ended.fileno()):
        poll.register(fd, select.POLLIN)

    def serve() -> None:
        """Handle events until the context ends."""
        while True:
            for fd, _ in poll.poll(10):
                if fd == ended.fileno():
                    return
                if by_fd[fd] in servers:
                    servers[by_fd[fd]].handle_events()
            for label in network.stopped & servers.keys():
                server = servers.pop(label)
                poll.unregister(server.fileno())
                server.close()

    thread = threading.Thread(target=serve, name="nodes", daemon=True)
    thread.start()
    try:
        yield [folder / label for label in servers]
    finally:
        waking.send(b"\0")
        thread.join()
        for server in servers.values():
            server.close()
        ended.close()
        waking.close()
