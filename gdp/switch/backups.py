"""Backup branches of multicast trees: from which neighbour to request one, and which branches one protects.

Sans-I/O. Source: RFC 5286 for the alternate upstream; RFC 7431 for the secondary join. In RFC 7431 a secondary tree
carries copies all the time. Here it carries none until the switch that has both branches loses the protected one. So no
link carries a message twice.
"""

from __future__ import annotations

from gdp.names import Name
from gdp.switch.forwarding_state import ForwardingState
from gdp.switch.trees import Downstream, Tree

__all__ = ["Backups"]


class Backups:
    """Computes the backup paths of trees.

    A backup never leaves the switch's domain, because the path choice of other domains is unknown.
    """

    def __init__(self, state: ForwardingState) -> None:
        self._state = state

    def upstream(self, tree: Tree) -> tuple[Downstream, Name] | None:
        """Return where to request a backup branch: the loop-free alternate towards the publisher, or None.

        A tree that follows a route has its second path instead.
        """
        if tree.path == 2:
            return None
        if tree.is_backup or tree.upstream is None or tree.switch == self._state.me or tree.guide is not None:
            return None
        path = self._state.paths.to_switch(tree.switch, tree.domain, tree.allowed)
        if path is None or path.alternate is None:
            return None
        neighbour = self._state.neighbours.cheapest(path.alternate)
        if neighbour is None or (at := (neighbour.port, neighbour.mac)) == tree.upstream or at in tree.branches:
            return None
        return at, neighbour.name

    def protection(self, tree: Tree) -> dict[Downstream, Downstream]:
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
