"""Several proxies in one ROS graph: which of them carries a name.

Place: pure. What two carried would arrive twice, and what one brought in the other would send out again. So each name
has one proxy. The virtual node of each shows itself by ``SIGN``; they are ranked by their names. The first begins at
once; the others wait, and begin only where nobody before them does. Where two have begun all the same, the later one
in rank ends; where the one that carries a name leaves, the next takes over.
"""

from __future__ import annotations

from typing import Final

from proxy.endpoints.endpoint import Graph, Role
from proxy.serial.channel import Channel, RosVersion

__all__ = ["SIGN", "BridgeElection", "presence_of", "sign"]

SIGN: Final = "/_gdp_proxy"
_STEP_S: Final = 0.4  # above what a graph takes to show a new end
_EMPTY: Final = "std_msgs/msg/Empty"


class BridgeElection:
    """What a graph shows of other proxies.

    Args:
        me: what our own virtual node is called.
    """

    def __init__(self, me: str, graph: Graph) -> None:
        self._me = me
        others = [(end.name, _short(end.node), end.role) for end in graph if end.is_proxy]
        nodes = {node for _, node, _ in others if node != me}
        self._rank = sum(node < me for node in nodes)
        self._carried: dict[str, set[str]] = {}
        for name, node, role in others:
            if node != me and role is not Role.CALLS:
                self._carried.setdefault(name, set()).add(node)

    @property
    def patience_s(self) -> float:
        """Return how long to wait before a name is ours."""
        return self._rank * _STEP_S

    def before_us(self, name: str, *, is_begun: bool) -> str:
        """Return the proxy that carries a local name instead of us, empty where none does.

        Args:
            is_begun: whether we carry it already; then only a proxy before us in rank counts.
        """
        nodes = self._carried.get(name, set())
        return min((node for node in nodes if not is_begun or node < self._me), default="")


def presence_of(service: str) -> str:
    """Return the topic by which a proxy shows that it carries a local server: masters do not know clients."""
    return SIGN + service


def sign(topic: str, ros: RosVersion) -> Channel:
    """Return the channel of a sign or a mark; nothing is ever published on it."""
    md5 = "d41d8cd98f00b204e9800998ecf8427e" if ros == 1 else ""  # of no text: the message has no fields
    return Channel(topic, _EMPTY, ros, hash=md5)


def _short(node: str) -> str:
    return node.rpartition("/")[2]
