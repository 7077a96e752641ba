"""Where a tree finds another way: the backup asked for above, and the branches that backups protect.

Place: pure.
Source: RFC 5286 for the alternate above; RFC 7431 for the secondary join. There a secondary tree carries copies all the
time; here it carries none until the switch that has both branches loses the protected one, so that no link carries a
message twice.
"""

from __future__ import annotations

from gdp.names import Name
from gdp.switch.outbox import Outbox
from gdp.switch.paths import Paths
from gdp.switch.trees import Downstream, Tree

__all__ = ["Backups"]


class Backups:
    """The ways of trees that are not their best.

    Args:
        me: this switch.
        own: its domain; a backup never leaves it, for how others choose their paths is theirs to know.
    """

    def __init__(self, me: Name, own: Name, paths: Paths, outbox: Outbox) -> None:
        self._me = me
        self._own = own
        self._paths = paths
        self._outbox = outbox

    def above(self, tree: Tree) -> tuple[Downstream, Name] | None:
        """Return whom a backup branch is to be asked of: the loop-free alternate towards the publisher, or None."""
        if tree.is_backup or tree.above is None or tree.switch == self._me:
            return None
        way = self._paths.to_switch(tree.switch, tree.domain, tree.allowed)
        if way is None or way.alternate is None:
            return None
        neighbour = self._outbox.neighbour(way.alternate)
        if neighbour is None or (at := (neighbour.port, neighbour.mac)) == tree.above or at in tree.branches:
            return None
        return at, neighbour.name

    def protection(self, tree: Tree) -> dict[Downstream, Downstream]:
        """Return, for each branch that a backup can take the place of, that backup.

        A backup protects the branch over which this switch would itself reach whoever asked for it, where messages
        that fit that branch fit the backup, too. Of several the one asked for by the nearest switch is taken.
        """
        found: dict[Downstream, tuple[int, Downstream]] = {}
        for at, branch in tree.branches.items():
            if branch.backup_for is None or branch.is_active:
                continue
            way = self._paths.to_switch(branch.backup_for, self._own, frozenset({self._own}))
            neighbour = None if way is None else self._outbox.neighbour(way.first)
            if way is None or neighbour is None:
                continue
            protected = neighbour.port, neighbour.mac
            other = tree.branches.get(protected)
            if other is None or not other.is_active or other.mtu > branch.mtu:
                continue
            found[protected] = min(found.get(protected, (way.distance, at)), (way.distance, at))
        return {protected: at for protected, (_, at) in found.items()}
