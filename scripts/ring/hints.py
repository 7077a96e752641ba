"""Hints for experiments with a ring that was kept.

I/O layer; it builds text, and prints nothing.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from gdp.host.run_registry import in_first_user_namespace
from lab.credentials import METRICS_PORTS
from ring.live_run import LiveRing
from ring.overlay import Overlay
from ring.run import Ring


def hints(ring: Ring, again: Path) -> list[tuple[str, str]]:
    """Return pairs of (effect, command line) in the recommended order; ``again``: the file of its new receiver."""
    replay = Path(sys.executable).with_name("gdp-replay")
    config = ring.overlay.credentials.file("proxy", ring.overlay.robot.switch)
    sender = f"{replay} {shlex.quote(str(ring.bag))} --config {config}"
    return [(f"send the recording again, into {again}", inside(ring.overlay, "nuc1", sender)), *common(ring.overlay)]


def live_hints(ring: LiveRing) -> list[tuple[str, str]]:
    """Return such pairs for a live ring."""
    found = []
    for at, graph in zip(("nuc1", "nuc5"), ring.graphs, strict=True):
        if graph.ros == 1:
            found.append((f"the topics at {at}", inside(ring.overlay, at, "rostopic list")))
            found.append((f"what is said at {at}", inside(ring.overlay, at, "rostopic echo -n 5 /chatter")))
        else:
            variables = " ".join(f"{name}={value}" for name, value in ring.environment(graph).items())
            listener = f"env {variables} timeout 5 {sys.executable} -m ring.nodes 2 listener 0"
            found.append((f"one more listener at {at}, for five seconds", inside(ring.overlay, at, listener)))
    proxy = inside(ring.overlay, "nuc5", _metrics("proxy"))
    logs = f"tail -n 3 {ring.directory}/*.log"
    return [*found, ("what the proxy at nuc5 counts", proxy), ("what all log", logs), *common(ring.overlay)]


def common(overlay: Overlay) -> list[tuple[str, str]]:
    """Return the pairs that apply to every ring."""
    script = Path(__file__).parents[2] / "scripts" / "ring_topology.sh"
    return [
        ("what the switch in the middle counts", inside(overlay, "nuc3", _metrics("switch"))),
        ("what passes it", inside(overlay, "nuc3", "tcpdump -e -i nuc4 ether proto 0x88b5")),
        ("cut the usual way, and watch the other be taken", inside(overlay, "nuc2", "ip link set nuc3 down")),
        ("take everything down", f"{script} --down"),
    ]


def inside(overlay: Overlay, node: str, command: str) -> str:
    """Return the shell command that runs a command in the namespace of a switch, from outside."""
    if in_first_user_namespace():
        return f"ip netns exec {overlay.namespaces[node].path.name} {command}"
    return f"nsenter --target {overlay.switches[node].pid} --user --mount --net --preserve-credentials {command}"


def _metrics(role: str) -> str:
    return f"curl -s http://127.0.0.1:{METRICS_PORTS[role]}/metrics"
