"""View of the facts about one name: its two ends, and whether the network between them is whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple, TypeAlias

from gdp.diagnosis.facts import Facts, FlowFact, GoneFact, ProxyFacts, RibFacts, SwitchFacts, WaitFact

Node: TypeAlias = ProxyFacts | SwitchFacts | RibFacts
Found: TypeAlias = tuple[str, str]  # sentence and command
Rule: TypeAlias = Callable[["View"], Iterator[Found]]

_GIVES: Final = ("publish", "serve")


class End(NamedTuple):
    """A flow of the name, and the proxy that has it."""

    proxy: ProxyFacts
    flow: FlowFact

    @property
    def place(self) -> str:
        """Return where it is, for a sentence."""
        return "here" if self.proxy.is_near else f"at proxy {short(self.proxy.name)}"


class View:
    """The facts, sorted by their part in the path."""

    def __init__(self, facts: Facts) -> None:
        self.facts = facts
        self.near = next((each for each in facts.proxies if each.is_near), None)
        ends = [End(proxy, flow) for proxy in facts.proxies for flow in proxy.flows]
        self.near_ends = [each for each in ends if each.proxy.is_near]
        self.overlays = {each.flow.overlay for each in self.near_ends if each.flow.overlay}
        same = [each for each in ends if each.proxy.is_near or each.flow.overlay in self.overlays]
        self.namesakes = [each for each in ends if each not in same]  # the same ROS name, another overlay name
        self.importers = [each for each in same if each.flow.side == "import"]
        self.exporters = [each for each in same if each.flow.side == "expose"]
        self.far_proxies = [each for each in facts.proxies if not each.is_near]

    @property
    def ends(self) -> list[End]:
        """Return both ends, that of the reader first."""
        return [*self.importers, *self.exporters]

    @property
    def nodes(self) -> list[Node]:
        """Return every node that answered."""
        return [*self.facts.proxies, *self.facts.switches, *self.facts.ribs]

    @property
    def members(self) -> list[ProxyFacts | SwitchFacts]:
        """Return the proxies and switches that answered."""
        return [*self.facts.proxies, *self.facts.switches]

    @property
    def is_service(self) -> bool:
        """Return whether the name is a service or an action."""
        return any(each.flow.kind != "topic" for each in self.ends)

    @property
    def advertisers(self) -> set[str]:
        """Return the nodes that publish or serve the name, as RIBs and switches know."""
        routes = {each.advertiser for rib in self.facts.ribs for each in rib.routes if each.right in _GIVES}
        places = (each for switch in self.facts.switches for each in switch.locations)
        return routes | {each.advertiser for each in places if each.right in _GIVES} | self._attached()

    @property
    def lapsed(self) -> list[GoneFact]:
        """Return the former advertisers whose leases ended, while there is no other."""
        if self.advertisers:
            return []
        return [each for rib in self.facts.ribs for each in rib.gone if each.how == "lapsed"]

    def reaches(self, switch: str, domain: str) -> bool:
        """Return whether a path leads from the near switch to a switch, as far as that is known."""
        near = next((each for each in self.facts.switches if each.is_near), None)
        if near is None or not near.reaches or domain != near.domain:
            return True
        return switch in near.reaches

    @property
    def is_torn(self) -> bool:
        """Return whether a part of the network that the name needs is missing."""
        return (
            any(not each.is_attached for each in self.facts.proxies)
            or any(not each.rib for each in self.facts.switches)
            or any(not each.is_reachable for switch in self.facts.switches for each in switch.locations)
            or any(each.is_down for each in self.facts.unreachable)
            or any(not self.reaches(each.switch, each.domain) for each in self.lapsed)
        )

    def waits(self, *reasons: str) -> Iterator[tuple[Node, WaitFact]]:
        """Yield what nodes wait for, those of the asker first."""
        for node in sorted(self.nodes, key=lambda node: not node.is_near):
            yield from ((node, wait) for wait in node.waits if wait.reason in reasons)

    def place_of(self, node: Node) -> str:
        """Return which node it is, for a sentence."""
        role = "proxy" if isinstance(node, ProxyFacts) else "switch" if isinstance(node, SwitchFacts) else "RIB"
        return f"the {role} here" if node.is_near else f"{role} {short(node.name)}"

    def _attached(self) -> set[str]:
        texts = (text.split(" ") for switch in self.facts.switches for text in switch.attached)
        return {node for node, right in texts if right in _GIVES}


def short(name: str) -> str:
    """Return the short form of a name, such as ``75e…0fc``."""
    return f"{name[:3]}…{name[-3:]}"
