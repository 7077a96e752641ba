"""Reverse-path trees: for each topic and publisher, the downstream branches and the upstream neighbour.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). A branch is soft state: it stands for a lease and is renewed
from downstream. A switch renews upstream for as long as a branch of its own stands.

A *backup* branch was requested by a switch that has the tree another way. It gets no copies while that path stands: in
the forwarding table it is the alternate of the branch that it protects.

A topic with ``paths: 2`` has two trees, the second one for second copies. Their joins bring routes, which the switches
of the readers chose. Of several routes a tree follows the shortest: what remains of it shrinks with every switch, so
that routes of different readers form no loop.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from gdp.control.join import Route, RouteLink
from gdp.due_queue import DueQueue
from gdp.frame.codec import second_path_key
from gdp.limits import FRAME_MAX_BYTES, PACE_MAX
from gdp.names import Name
from gdp.switch.table import MACS_BYTES, Hop, Hops, Paces, ProtectedHop, sides_of

Downstream = tuple[int, bytes]  # port, MAC of the downstream neighbour
TreeKey = tuple[Name, Name, int]  # topic, publisher and path


@dataclass(slots=True, kw_only=True)
class Branch:
    """One downstream neighbour that wants a copy."""

    expires_s: float
    mtu: int  # smallest on the path downstream, the link to that neighbour included
    evidence: bytes  # the signed advertisement of a downstream reader
    said_mtu: int = FRAME_MAX_BYTES  # the path MTU in the neighbour's join; a reader sends none
    sequence: int = 0  # of its last join
    session: bytes = b""  # of the neighbour that sent it, within which the sequence rises
    backup_for: Name | None = None  # the switch that requested a backup; None: an ordinary branch
    active_until_s: float | None = None  # a backup whose protected branch was lost gets copies until then
    route: Route = ()  # from here to the publisher's switch, as the reader's switch chose it
    wants_pair: bool = False  # a reader attached here for which this switch chooses the routes
    place: tuple[Name, Name] | None = None  # switch and domain of the publisher, as its last join named them
    proven_until_s: float = float("inf")  # no refresh prolongs it beyond
    pace: int = PACE_MAX  # frames of a higher one are for faster branches

    @property
    def is_active(self) -> bool:
        """Return whether it gets copies."""
        return self.backup_for is None or self.active_until_s is not None

    def fit(self, link_mtu: int) -> None:
        """Apply the link MTU to the neighbour."""
        self.mtu = min(self.said_mtu, link_mtu)


class JoinTerms(NamedTuple):
    """What a join asks for, in the two sessions of a link: while nothing of it changes, its number renews it."""

    sessions: tuple[bytes, bytes]
    switch: Name
    domain: Name
    allowed: frozenset[Name]
    mtu: int
    backup_for: Name
    route: Route
    pace: int


class SentJoin(NamedTuple):
    """The last join of a tree to one neighbour."""

    number: int
    name: Name  # of the neighbour
    terms: JoinTerms


@dataclass(slots=True, kw_only=True)
class Tree:
    """The tree of one topic and one publisher at this switch; ``path`` 2 is that of the second copies."""

    topic: Name
    publisher: Name
    path: int = 1
    switch: Name  # where the publisher is attached
    domain: Name  # of that switch
    allowed: frozenset[Name]
    branches: dict[Downstream, Branch] = field(default_factory=dict)
    upstream: Downstream | None = None  # the neighbour that received the last join
    upstream_name: Name | None = None
    renew_at_s: float = 0.0
    asked_route: Route = ()  # route in the last join
    followed: Route = ()  # that the upstream neighbour was chosen by
    shown: bytes = b""  # evidence in the last whole join
    shown_of: Downstream | None = None  # the branch that it is of
    version: int = 0  # sequence number of ``proof``
    proof: bytes = b""  # the publisher's advertisement that ``switch`` was read from
    joins: int = 0  # sent to the upstream neighbour since it was chosen
    sent: dict[Downstream, SentJoin] = field(default_factory=dict)  # by neighbour that has a join of ours
    prove_at_s: float = 0.0  # from then on the next join is sent whole
    unknown: int = 0  # replies since the upstream neighbour was chosen that it does not know our join
    has_moved: bool = False  # the publisher has moved since the upstream neighbour was chosen
    former: tuple[Downstream, Name] | None = None  # the former upstream neighbour, until ``former_until_s``
    former_until_s: float = 0.0
    is_doubted: bool = False  # the evidence is invalid
    backup: tuple[Downstream, Name] | None = None  # the neighbour that received the request for a backup branch
    former_ports: set[int] = field(default_factory=set)  # copies may still come from them, until all has settled
    protection: dict[Downstream, Downstream] = field(default_factory=dict)  # branch to the backup that replaces it

    @property
    def identity(self) -> TreeKey:
        """Return topic, publisher and path."""
        return self.topic, self.publisher, self.path

    @property
    def key(self) -> bytes:
        """Return its key in the forwarding table."""
        topic = bytes(self.topic) if self.path == 1 else second_path_key(self.topic)
        return topic + bytes(self.publisher)

    @property
    def guide(self) -> Branch | None:
        """Return the branch whose route this tree follows, or None: the shortest one, the present one before others."""
        routed = [at for at, each in self.branches.items() if each.route]
        if not routed:
            return None
        routes = {at: self.branches[at].route for at in routed}
        return self.branches[min(routed, key=lambda at: (len(routes[at]), routes[at] != self.followed, at))]

    @property
    def next_link(self) -> RouteLink | None:
        """Return the link to the upstream neighbour that the route names, or None without a route."""
        guide = self.guide
        return None if guide is None else guide.route[0]

    @property
    def mtu(self) -> int:
        """Return the smallest MTU downstream; a backup makes no messages smaller."""
        return min(branch.mtu for branch in self._wanted())

    @property
    def pace(self) -> int:
        """Return the highest pace downstream."""
        return max((branch.pace for branch in self._wanted()), default=PACE_MAX)

    @property
    def evidence(self) -> bytes:
        """Return the advertisement of the reader whose route it follows, or else whose branch has the longest lease."""
        if (guide := self.guide) is not None:
            return guide.evidence
        return max(self._wanted(), key=lambda branch: branch.expires_s).evidence

    @property
    def backup_for(self) -> Name | None:
        """Return for which downstream switch this tree is only a backup; None: a neighbour wants copies."""
        return max(self._wanted(), key=lambda branch: branch.expires_s).backup_for if self.is_backup else None

    @property
    def is_backup(self) -> bool:
        """Return whether no downstream neighbour wants copies now."""
        return not any(branch.is_active for branch in self.branches.values())

    def _wanted(self) -> list[Branch]:
        """Return the branches that get copies; a tree of backups alone sends to each of them."""
        active = [branch for branch in self.branches.values() if branch.is_active]
        return active or list(self.branches.values())

    def expires_s(self) -> float:
        """Return when the last branch ends."""
        return max(branch.expires_s for branch in self.branches.values())

    @property
    def sides(self) -> int:
        """Return the ports that copies may come from: of the present and the recent upstream neighbour.

        Without either, the mask is empty.
        """
        asked = [self.upstream] if self.upstream is not None else []
        asked += [each[0] for each in (self.former, self.backup) if each is not None]
        return sides_of([*(port for port, _ in asked), *self.former_ports])

    def next_s(self) -> float:
        """Return when something is due: a renewal, or the end of a lease, an overlap or a backup's activity."""
        times = [self.renew_at_s]
        if self.former is not None:
            times.append(self.former_until_s)
        for branch in self.branches.values():
            times.append(branch.expires_s)
            if branch.active_until_s is not None:
                times.append(branch.active_until_s)
        return min(times)

    @property
    def is_wanted_below(self) -> bool:
        """Return whether any neighbour except the upstream one wants a copy."""
        return any(at != self.upstream for at in self.branches)

    def hops(self, mac_of: dict[int, bytes]) -> Hops:
        """Return where copies go: one per active branch, in a stable order, with its backup as the alternate.

        No copy goes back to the upstream neighbour (split horizon): while links settle, two neighbours may each join
        the other.
        """
        only_backups = self.is_backup
        below = [
            at
            for at in sorted(self.branches)
            if at != self.upstream and at[0] in mac_of and (only_backups or self.branches[at].is_active)
        ]
        hops: list[Hop | ProtectedHop] = []
        for port, mac in below:
            hop = port, mac + mac_of[port]
            backup = self.protection.get((port, mac))
            if backup is None or backup == self.upstream or backup[0] not in mac_of:
                hops.append(hop)
            else:
                hops.append((*hop, backup[0], backup[1] + mac_of[backup[0]]))
        return tuple(hops)

    def paces(self, hops: Hops) -> Paces:
        """Return the pace of the branch of each hop."""
        return tuple(self.branches[hop[0], hop[1][: MACS_BYTES // 2]].pace for hop in hops)


class Trees:
    """All trees that pass one switch, and which is due next.

    A caller may change the trees that it receives. So their timers are read again before the next check: the cost is
    proportional to the trees that changed.
    """

    def __init__(self) -> None:
        self._by_topic: dict[Name, dict[tuple[Name, int], Tree]] = {}
        self._size = 0
        self._touched: dict[TreeKey, Tree] = {}
        self._due = DueQueue[TreeKey](is_sorted=True)

    def __len__(self) -> int:
        return self._size

    def get(self, topic: Name, publisher: Name, path: int = 1) -> Tree | None:
        """Return a tree, or None."""
        tree = self._by_topic.get(topic, {}).get((publisher, path))
        if tree is not None:
            self._touched[tree.identity] = tree
        return tree

    def peek(self, key: TreeKey) -> Tree | None:
        """Return a tree to be read only, or None: its timers are not read again."""
        return self._by_topic.get(key[0], {}).get(key[1:])

    def both(self, topic: Name, publisher: Name) -> list[Tree]:
        """Return the trees of a topic and a publisher: none, one, or that of second copies too."""
        found = [self.get(topic, publisher, path) for path in (1, 2)]
        return [tree for tree in found if tree is not None]

    def all(self) -> list[Tree]:
        """Return every tree."""
        return [tree for topic in list(self._by_topic) for tree in self.of_topic(topic)]

    def present(self) -> Iterator[Tree]:
        """Yield every tree, to be read only: its timers are not read again."""
        for trees in self._by_topic.values():
            yield from trees.values()

    def of_topic(self, topic: Name) -> list[Tree]:
        """Return a topic's trees."""
        trees = list(self._by_topic.get(topic, {}).values())
        self._touched.update({tree.identity: tree for tree in trees})
        return trees

    def put(self, tree: Tree) -> None:
        """Add a tree."""
        trees = self._by_topic.setdefault(tree.topic, {})
        self._size += (tree.publisher, tree.path) not in trees
        trees[tree.publisher, tree.path] = tree
        self._touched[tree.identity] = tree

    def remove(self, tree: Tree) -> None:
        """Remove a tree."""
        trees = self._by_topic.get(tree.topic, {})
        if trees.pop((tree.publisher, tree.path), None) is not None:
            self._size -= 1
        if not trees:
            self._by_topic.pop(tree.topic, None)
        self._touched.pop(tree.identity, None)
        self._due.discard(tree.identity)

    def due(self, now_s: float) -> list[Tree]:
        """Return the trees with a timer that is due; each is returned again while that is so."""
        self._schedule()
        due = {key: self._by_topic[key[0]][key[1:]] for key in self._due.poll_due(now_s)}
        self._touched.update(due)
        return list(due.values())

    def next_event(self) -> float | None:
        """Return the monotonic second at which something is due next, or None."""
        self._schedule()
        return self._due.next_due()

    def _schedule(self) -> None:
        for key, tree in self._touched.items():
            self._due.put(key, tree.next_s())
        self._touched.clear()


def owner_of(at: Downstream) -> bytes:
    """Return the owner whose quota the state of a neighbour uses."""
    return at[0].to_bytes(4, "big") + at[1]
