"""What to try with a ring that was left standing.

Place: shell; makes text, prints nothing.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from gdp.testbed.runs import in_first_user_namespace
from proxy.ring.plan import METRICS_PORTS
from proxy.ring.run import Ring

__all__ = ["hints"]


def hints(ring: Ring, again: Path) -> list[tuple[str, str]]:
    """Return (what it does, command line) in the order in which a person might try them.

    Args:
        ring: still standing.
        again: what its new receiver records into.
    """
    replay = Path(sys.executable).with_name("gdp-replay")
    sender = f"{replay} {shlex.quote(str(ring.bag))} --config {ring.sender_config}"
    metrics = f"curl -s http://127.0.0.1:{METRICS_PORTS['switch']}/metrics"
    script = Path(__file__).parents[2] / "scripts" / "ring_topology.sh"
    return [
        (f"send the recording again, into {again}", _inside(ring, "nuc1", sender)),
        ("what the switch in the middle counts", _inside(ring, "nuc3", metrics)),
        ("what passes it", _inside(ring, "nuc3", "tcpdump -e -i nuc4 ether proto 0x88b5")),
        ("cut the usual way, and watch the other be taken", _inside(ring, "nuc2", "ip link set nuc3 down")),
        ("take everything down", f"{script} --down"),
    ]


def _inside(ring: Ring, node: str, command: str) -> str:
    """Return what a person types, from outside, to run a command in the namespace of a switch."""
    if in_first_user_namespace():
        return f"ip netns exec {ring.namespaces.path(node).name} {command}"
    return f"nsenter --target {ring.switches[node].pid} --user --mount --net --preserve-credentials {command}"
