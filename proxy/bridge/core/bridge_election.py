"""Bridge election: which of several proxies in one ROS graph carries a name.

Sans-I/O. If two proxies carried a name, its messages would arrive twice, and one proxy would send out again what the
other one brought in. So each name has one proxy. The virtual node of each proxy advertises the topic ``SIGN``; the
proxies are ranked by the names of these nodes. The first begins at once. The others wait, and begin only where no
proxy before them carries the name. If two have begun all the same, the later one in rank ends its flow. If the proxy
that carries a name leaves, the next one takes over.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from gdp.names import Name
from proxy.endpoints.core.endpoint import Graph, Role
from proxy.serial.channel import EMPTY_MD5, Channel, RosVersion

SIGN: Final = "/_gdp_proxy"
_FAR: Final = f"{SIGN}/_node"
_RULE: Final = f"{SIGN}/_nodes/n"
_STEP_S: Final = 0.4  # longer than a graph takes to show a new entity
_EMPTY: Final = "std_msgs/msg/Empty"


class BridgeElection:
    """Other proxies of a graph, as the graph shows them; ``me``: name of this proxy's virtual node."""

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
        """Return the seconds to wait before this proxy may carry a name."""
        return self._rank * _STEP_S

    def before_us(self, name: str, *, is_begun: bool) -> str:
        """Return the proxy that carries a local name instead of this one, empty if there is none.

        Args:
            is_begun: whether this proxy carries it already; then only a proxy before it in rank counts.
        """
        nodes = self._carried.get(name, set())
        return min((node for node in nodes if not is_begun or node < self._me), default="")


def presence_of(service: str) -> str:
    """Return the topic by which a proxy shows that it carries a local server: ROS 1 masters do not know clients."""
    return SIGN + service


def presence_of_node(node: str) -> str:
    """Return the topic by which a proxy shows that a node of its graph is a far one, which appears there."""
    return f"{_FAR}{node}"


def presence_of_nodes(name: Name) -> str:
    """Return the topic by which a proxy shows that it carries the nodes of a rule, which have one overlay name."""
    return _RULE + name.to_text()


def attributed(graph: Graph) -> Graph:
    """Return the graph with the entities of far nodes as those of the proxies by which they appear."""
    proxies = {
        end.name.removeprefix(_FAR): end.node for end in graph if end.is_proxy and end.name.startswith(f"{_FAR}/")
    }
    return frozenset(replace(end, node=proxies.get(end.node, end.node)) for end in graph) if proxies else graph


def sign(topic: str, ros: RosVersion) -> Channel:
    """Return the channel of a presence topic; nothing is ever published on it."""
    return Channel(topic, _EMPTY, ros, hash=EMPTY_MD5 if ros == 1 else "")


def _short(node: str) -> str:
    return node.rpartition("/")[2]
