"""Reverse-path trees: for each topic and publisher, who wants a copy below, and whom it is asked of above.

Place: pure; time comes in as ``now_s`` (monotonic seconds). A branch is soft state: it stands for a lease and is
renewed from below; a switch renews upwards for as long as a branch of its own stands.

A *backup* branch was asked for by a switch that has the tree another way. It gets no copies while that way stands:
in the forwarding table it is the alternate of the branch that it protects.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from gdp.limits import FRAME_MAX_BYTES
from gdp.names import Name
from gdp.switch.table import Hop, Hops, ProtectedHop

__all__ = ["Branch", "Tree", "Trees"]

At = tuple[int, bytes]  # port, MAC of the one below


@dataclass(slots=True)
class Branch:
    """One neighbour below that wants a copy."""

    expires_s: float
    mtu: int  # smallest on the way down, the link to that neighbour included
    evidence: bytes  # the signed claim of a reader down there
    said_mtu: int = FRAME_MAX_BYTES  # what the neighbour said of the way; a reader says nothing
    sequence: int = 0  # of its last join
    session: bytes = b""  # of the neighbour that sent it, within which the sequence rises
    backup_for: Name | None = None  # the switch that asked for a backup; None: an ordinary branch
    active_until_s: float | None = None  # a backup whose protected branch was lost gets copies until then

    @property
    def is_active(self) -> bool:
        """Return whether it gets copies."""
        return self.backup_for is None or self.active_until_s is not None

    def fit(self, link_mtu: int) -> None:
        """Take in what the link to the neighbour takes now."""
        self.mtu = min(self.said_mtu, link_mtu)


@dataclass(slots=True)
class Tree:
    """One topic from one publisher, as it passes this switch."""

    topic: Name
    publisher: Name
    switch: Name  # where the publisher is attached
    domain: Name  # of that switch
    allowed: frozenset[Name]
    branches: dict[At, Branch] = field(default_factory=dict)
    above: At | None = None  # whom the last join went to
    above_name: Name | None = None
    renew_at_s: float = 0.0
    asked_mtu: int = 0  # what the last join said
    shown: bytes = b""  # the evidence that it carried
    version: int = 0  # sequence number of the publisher's claim that ``switch`` was read from
    joins: int = 0  # that the one above was sent since it was chosen
    has_moved: bool = False  # the publisher has, since the one above was chosen
    former: tuple[At, Name] | None = None  # whom this tree took its messages from before, until ``former_until_s``
    former_until_s: float = 0.0
    is_doubted: bool = False  # that proves nothing any more
    asked_backup_for: Name | None = None  # what the last join said
    backup: tuple[At, Name] | None = None  # whom a backup branch was asked of
    protection: dict[At, At] = field(default_factory=dict)  # branch to the backup that takes its place

    @property
    def key(self) -> bytes:
        """Return its key in the forwarding table."""
        return bytes(self.topic) + bytes(self.publisher)

    @property
    def mtu(self) -> int:
        """Return the smallest MTU below here; a backup makes no messages smaller."""
        return min(branch.mtu for branch in self._wanted())

    @property
    def evidence(self) -> bytes:
        """Return the claim of the reader whose branch stands longest."""
        return max(self._wanted(), key=lambda branch: branch.expires_s).evidence

    @property
    def backup_for(self) -> Name | None:
        """Return for which switch below this tree is only a backup; None: somebody wants copies."""
        return max(self._wanted(), key=lambda branch: branch.expires_s).backup_for if self.is_backup else None

    @property
    def is_backup(self) -> bool:
        """Return whether nobody below wants copies now."""
        return not any(branch.is_active for branch in self.branches.values())

    def _wanted(self) -> list[Branch]:
        """Return the branches that get copies; a tree of backups alone gives each what comes."""
        active = [branch for branch in self.branches.values() if branch.is_active]
        return active or list(self.branches.values())

    def expires_s(self) -> float:
        """Return when the last branch ends."""
        return max(branch.expires_s for branch in self.branches.values())

    @property
    def is_wanted_below(self) -> bool:
        """Return whether anybody but the one above wants a copy."""
        return any(at != self.above for at in self.branches)

    def hops(self, mac_of: dict[int, bytes]) -> Hops:
        """Return where copies go: one per active branch, in a stable order, with its backup as the alternate.

        None goes back to the one above (split horizon): while links settle, two neighbours may each ask the other.
        """
        only_backups = self.is_backup
        below = [
            at
            for at in sorted(self.branches)
            if at != self.above and at[0] in mac_of and (only_backups or self.branches[at].is_active)
        ]
        hops: list[Hop | ProtectedHop] = []
        for port, mac in below:
            hop = port, mac + mac_of[port]
            backup = self.protection.get((port, mac))
            if backup is None or backup == self.above or backup[0] not in mac_of:
                hops.append(hop)
            else:
                hops.append((*hop, backup[0], backup[1] + mac_of[backup[0]]))
        return tuple(hops)


class Trees:
    """All trees that pass one switch."""

    def __init__(self) -> None:
        self._trees: dict[tuple[Name, Name], Tree] = {}

    def __len__(self) -> int:
        return len(self._trees)

    def get(self, topic: Name, publisher: Name) -> Tree | None:
        """Return a tree, or None."""
        return self._trees.get((topic, publisher))

    def all(self) -> list[Tree]:
        """Return every tree."""
        return list(self._trees.values())

    def of_topic(self, topic: Name) -> list[Tree]:
        """Return a topic's trees."""
        return [tree for (its, _), tree in self._trees.items() if its == topic]

    def put(self, tree: Tree) -> None:
        """Add a tree."""
        self._trees[tree.topic, tree.publisher] = tree

    def remove(self, tree: Tree) -> None:
        """Take a tree away."""
        self._trees.pop((tree.topic, tree.publisher), None)

    def prune(self, now_s: float) -> list[Tree]:
        """Cut branches whose lease ended; return the trees that changed, bare ones too."""
        changed = []
        for tree in self._trees.values():
            late = [at for at, branch in tree.branches.items() if branch.expires_s <= now_s]
            for at in late:
                del tree.branches[at]
            if late:
                changed.append(tree)
        return changed

    def deactivate(self, now_s: float) -> list[Tree]:
        """Let backups rest whose time is over; return the trees that changed."""
        changed = []
        for tree in self._trees.values():
            late = [
                branch
                for branch in tree.branches.values()
                if branch.active_until_s is not None and branch.active_until_s <= now_s
            ]
            for branch in late:
                branch.active_until_s = None
            if late:
                changed.append(tree)
        return changed

    def next_event(self) -> float | None:
        """Return the monotonic second of the next renewal or lease end, or None."""
        times = [tree.renew_at_s for tree in self._trees.values()]
        times += [tree.former_until_s for tree in self._trees.values() if tree.former is not None]
        branches = [branch for tree in self._trees.values() for branch in tree.branches.values()]
        times += [branch.expires_s for branch in branches]
        times += [branch.active_until_s for branch in branches if branch.active_until_s is not None]
        return min(times, default=None)
