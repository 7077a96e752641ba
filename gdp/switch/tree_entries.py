"""Forwarding entries of multicast trees: where the copies of a tree go, and second copies to its publisher.

Sans-I/O. A second copy to a publisher, such as an AckNack, goes up a tree of second copies. A backup branch is the
alternate of the branch that it protects.
"""

from __future__ import annotations

from collections import Counter

from gdp.errors import DropReason
from gdp.frame.codec import second_path_key
from gdp.names import Name
from gdp.switch.forwarding_state import ForwardingState
from gdp.switch.trees import Downstream, Tree


class TreeEntries:
    """The forwarding entries of one switch's multicast trees."""

    def __init__(self, state: ForwardingState) -> None:
        self._state = state
        self._second: dict[Name, dict[Name, Tree]] = {}  # trees of second copies, by publisher and topic
        self.drops: Counter[DropReason] = Counter()

    def install(self, tree: Tree) -> None:
        """Install the entry of a tree that has branches, with its backups."""
        tree.protection = self._protection(tree)
        hops = tree.hops(self._state.neighbours.own_macs())
        if not self._state.table.install(tree.key, hops, tree.expires_s(), tree.sides, tree.paces(hops)):
            self.drops[DropReason.QUOTA] += 1
        if tree.path == 2:
            self._second.setdefault(tree.publisher, {})[tree.topic] = tree
            self._install_to_publisher(tree.publisher)

    def reinstall(self, tree: Tree) -> None:
        """Install the entry of a tree again where its backups protect other branches now."""
        if self._protection(tree) != tree.protection:
            self.install(tree)

    def reinstall_second(self) -> None:
        """Install again where second copies to publishers go."""
        for publisher in list(self._second):
            self._install_to_publisher(publisher)

    def remove(self, tree: Tree) -> None:
        """Remove the entry of a tree."""
        self._state.table.remove(tree.key)
        trees = self._second.get(tree.publisher, {})
        if tree.path == 2 and trees.pop(tree.topic, None) is not None:
            self._install_to_publisher(tree.publisher)
        if not trees:
            self._second.pop(tree.publisher, None)

    def _install_to_publisher(self, publisher: Name) -> None:
        """Lead second copies to a publisher itself, such as AckNacks and answers, up one of its second trees.

        Of several trees it is the one with the shortest route, so that these paths form no loop either.
        """
        macs, key = self._state.neighbours.own_macs(), second_path_key(publisher)
        best: tuple[int, Name] | None = None
        for topic, tree in self._second.get(publisher, {}).items():
            if tree.upstream is not None and tree.upstream[0] in macs and tree.branches:
                found = len(tree.guide.route) if tree.guide is not None else 0, topic
                best = found if best is None else min(best, found)
        if best is None:
            self._state.table.remove(key)
            return
        tree = self._second[publisher][best[1]]
        port, mac = self._apart_from_ordinary(tree) or (0, b"")
        if not self._state.table.install(key, ((port, mac + macs[port]),), tree.expires_s()):
            self.drops[DropReason.QUOTA] += 1

    def _apart_from_ordinary(self, second: Tree) -> Downstream | None:
        """Return where second copies to the publisher of a second tree go: not over the link that first copies take.

        Of parallel links to one neighbour the first copies take the cheapest, which may be that of the second tree.
        """
        first = self._state.trees.get(second.topic, second.publisher)
        if first is None or first.upstream is None or first.upstream_name != second.upstream_name:
            return second.upstream
        ordinary = self._state.neighbours.cheapest(first.upstream_name) if first.upstream_name is not None else None
        is_taken = ordinary is not None and (ordinary.port, ordinary.mac) == second.upstream
        return first.upstream if is_taken else second.upstream

    def _protection(self, tree: Tree) -> dict[Downstream, Downstream]:
        """Return, for each branch that a backup can replace, that backup.

        A backup protects the branch over which this switch would itself reach the switch that requested the backup.
        Messages that fit that branch must also fit the backup. Of several backups, the one that the nearest switch
        requested is taken.
        """
        own = self._state.policy.own
        found: dict[Downstream, tuple[int, Downstream]] = {}
        for at, branch in tree.branches.items():
            if branch.backup_for is None or branch.is_active:
                continue
            path = self._state.paths.to_switch(branch.backup_for, own, frozenset({own}))
            neighbour = None if path is None else self._state.neighbours.cheapest(path.first)
            if path is None or neighbour is None:
                continue
            protected = neighbour.port, neighbour.mac
            other = tree.branches.get(protected)
            if other is None or not other.is_active or other.mtu > branch.mtu:
                continue
            found[protected] = min(found.get(protected, (path.distance, at)), (path.distance, at))
        return {protected: at for protected, (_, at) in found.items()}
