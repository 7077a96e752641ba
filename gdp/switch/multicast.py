"""Multicast trees of a switch: readers and joins from downstream make branches, and branches make joins upstream.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: after PIM-SM (RFC 7761).

A reader's advertisement and each known publisher of its topic make a tree. So do a server with each client, and a
client with each server; here they are called reader and publisher. While a branch stands, a switch renews its join to
the next switch towards the publisher (``upstream_joins.py``). It joins another one at once when the path changes. A
join carries the smallest MTU downstream, so it is sent again at once when that changes: a reader came or left, or a
link became narrower or wider.

A reader and a publisher that both ask for two paths get two trees (``docs/explanation/two-paths.md``). The reader's
switch chooses the routes of both (``path_pairs.py``), and the joins bring them along.

Where a branch and its backup part, the data plane uses the backup as soon as the port of the protected branch is down.
The branch itself is lost a moment later. The backup then counts as a branch for ``_ACTIVE_S``, in which the downstream
switch joins again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from gdp.control.join import Join, JoinRefresh
from gdp.control.neighbour import Neighbour
from gdp.control.pace import ReaderPace
from gdp.crypto.certificates import Role
from gdp.errors import DropReason, StatementError
from gdp.intervals import JOIN, JOIN_PROOF
from gdp.limits import PACE_MAX, TREES_MAX
from gdp.message.shares import Shares
from gdp.names import ZERO, Name
from gdp.switch.forwarding_state import ForwardingState
from gdp.switch.joins import JoinSender, ReceivedJoins
from gdp.switch.name_cache import Location
from gdp.switch.path_pairs import PathPairs
from gdp.switch.tree_entries import TreeEntries
from gdp.switch.trees import Branch, Downstream, Tree, owner_of
from gdp.switch.upstream_joins import OVERLAP_S, UpstreamJoins
from gdp.trust.advertisement import Advertisement
from gdp.trust.right import HEARS

_ACTIVE_S: Final = 1.0  # for which a backup replaces a branch that was lost


class MulticastTrees:
    """The multicast trees of one switch.

    Args:
        first_sequence: of our joins.

    Attributes:
        upstream: joins of the trees to their upstream neighbours.
        drops: what was refused, by reason.
    """

    def __init__(self, state: ForwardingState, first_sequence: int) -> None:
        self._state = state
        self._is_leaf = state.identity.role is Role.LEAF
        self._pairs = PathPairs(state.me, state.paths)
        self._branch_shares = Shares(TREES_MAX)
        self._paired: set[tuple[Name, Name]] = set()  # topics and publishers that readers here want over two paths
        self.trees = state.trees
        self._joins = JoinSender(state, first_sequence)
        self._received = ReceivedJoins()
        self._entries = TreeEntries(state)
        self.drops = self._entries.drops
        self.upstream = UpstreamJoins(state, self._entries, self._joins)

    def add_reader(self, advertisement: Advertisement, at: Downstream, locations: list[Location], now_s: float) -> None:
        """Add the verified advertisement of an attached reader; with the first one of a name it is watched.

        Raises:
            StatementError: QUOTA, the node reads too many topics.
        """
        is_first = self._state.readers.put(advertisement, at, now_s)
        for location in locations:
            self.publisher_found(location, now_s)
        if is_first:
            self._state.resolver.watch(advertisement.name, now_s)

    def remove_reader(self, topic: Name, at: Downstream) -> None:
        """Remove a reader; with the last one of a topic its watch ends."""
        is_last = self._state.readers.remove(topic, at)
        for tree in self.trees.of_topic(topic):
            self._cut(tree, at)
        if is_last:
            self._state.resolver.unwatch(topic)

    def publisher_found(self, location: Location, now_s: float) -> None:
        """Join a publisher of a topic that has readers here, or follow it."""
        place = location.switch, location.domain, location.sequence, location.advertisement
        for at, reader in self._state.readers.of(location.name).items():
            if (
                reader.advertisement.node == location.advertiser
                or HEARS[reader.advertisement.right] is not location.right
            ):
                continue  # a publisher does not receive its own messages
            allowed = (self._state.policy.transit & location.transit) | {self._state.policy.own, location.domain}
            tree = self._tree(location.name, location.advertiser, allowed)
            if location.sequence >= tree.version:
                self.upstream.place_at(tree, *place)
                tree.allowed = allowed
            before = tree.branches.get(at)
            branch = Branch(
                expires_s=reader.expires_s,
                mtu=self._state.neighbours.mtu_of(at[0]),
                evidence=reader.advertisement.wire,
                wants_pair=reader.advertisement.paths > 1 and location.proof is not None and location.proof.paths > 1,
                pace=PACE_MAX if before is None else before.pace,
            )
            if not self._put_branch(tree, at, branch):
                self.drops[DropReason.QUOTA] += 1
                continue
            self._route_pair(tree, now_s)
            self._entries.install(tree)
            self.upstream.assure(tree, now_s)

    def publisher_attached(self, advertisement: Advertisement, now_s: float) -> None:
        """Handle a publisher's advertisement of its topic here: trees that pass here join it directly at once."""
        for tree in self.trees.both(advertisement.name, advertisement.node):
            version = max(advertisement.sequence, tree.version)
            self.upstream.place_at(tree, self._state.me, self._state.policy.own, version, advertisement.wire)
            tree.renew_at_s = now_s
            self._route_pair(tree, now_s)

    def publisher_moved(self, location: Location, now_s: float) -> None:
        """Reroute a publisher's tree to its new location, if it passes here and its readers allow the path there."""
        place = location.switch, location.domain, location.sequence, location.advertisement
        for tree in self.trees.both(location.name, location.advertiser):
            if location.sequence >= tree.version and location.domain in tree.allowed:
                self.upstream.place_at(tree, *place)
                self._route_pair(tree, now_s)
                if tree.branches and not self.upstream.follow(tree, now_s):
                    self.upstream.restate(tree)

    def below(self, topic: Name, publisher: Name) -> list[Downstream]:
        """Return the neighbouring switches that receive a tree from here."""
        readers = self._state.readers.of(topic)
        found = (at for tree in self.trees.both(topic, publisher) for at in tree.branches if at not in readers)
        return list(dict.fromkeys(found))

    def publisher_gone(self, topic: Name, publisher: Name) -> None:
        """Remove the readers attached here from a tree whose publisher is gone."""
        for tree in self.trees.both(topic, publisher):
            for at in self._state.readers.of(topic):
                self._cut(tree, at)

    def reader_moved(self, location: Location) -> None:
        """Remove a reader that is attached elsewhere now."""
        for at, reader in list(self._state.readers.of(location.name).items()):
            if reader.advertisement.node == location.advertiser and reader.advertisement.sequence < location.sequence:
                self.remove_reader(location.name, at)
                return

    def join(self, join: Join, neighbour: Neighbour, now_s: float) -> bool:
        """Handle a verified join (or, with no lease, a leave) from a downstream switch.

        Returns:
            Whether it targets the publisher's former location.

        Raises:
            StatementError: the path may not lead through here.
        """
        at = (neighbour.port, neighbour.mac)
        if join.lease_s == 0:
            tree = self.trees.get(join.topic, join.publisher, join.path)
            if tree is not None and at in tree.branches and not _is_overtaken(join, tree.branches[at]):
                self._cut(tree, at)
            return False
        if self._is_leaf and join.switch != self._state.me:
            raise StatementError(DropReason.THROUGH_LEAF, "a tree that would pass a leaf")
        if self._state.policy.own not in join.allowed or neighbour.domain not in join.allowed:
            raise StatementError(DropReason.WRONG_DOMAIN, "a tree that must not pass here")
        if join.backup_for != ZERO and neighbour.domain != self._state.policy.own:
            raise StatementError(DropReason.WRONG_DOMAIN, "a backup for another domain")
        if self._state.paths.domain_of(join.switch) not in (None, join.domain):
            raise StatementError(DropReason.WRONG_DOMAIN, "the publisher's switch is of another domain")
        self._check_route(join, neighbour)
        tree = self._tree(join.topic, join.publisher, join.allowed, join.path)
        before = tree.branches.get(at)
        if before is not None and _is_overtaken(join, before):
            return False
        if tree.former is not None and tree.former[0] == at and join.backup_for == ZERO:
            self.upstream.leave_former(tree)  # it takes the messages from here now
        is_behind = join.version < tree.version
        if join.version >= tree.version:
            self.upstream.place_at(tree, join.switch, join.domain, join.version, join.proof)
            tree.allowed = join.allowed
        branch = Branch(
            expires_s=now_s + min(join.lease_s, JOIN.lease_s),
            mtu=join.mtu,
            evidence=join.evidence,
            said_mtu=join.mtu,
            sequence=join.sequence,
            session=join.sender_session,
            route=join.route,
            place=(join.switch, join.domain),
            proven_until_s=now_s + JOIN_PROOF.lease_s,
            pace=join.pace,
        )
        branch.fit(self._state.neighbours.mtu_of(neighbour.port))
        if join.backup_for != ZERO:
            branch.backup_for = join.backup_for
            branch.active_until_s = None if before is None else before.active_until_s
        if not self._put_branch(tree, at, branch):
            raise StatementError(DropReason.QUOTA, "branches of one neighbour")
        if before is not None:
            self._received.remove(at, before.sequence)
        if at == tree.shown_of and join.evidence != tree.shown:
            tree.prove_at_s = 0.0
        self._received.put(at, join.sequence, tree)
        self._entries.install(tree)
        self.upstream.assure(tree, now_s)
        return is_behind and tree.switch != join.switch

    def refresh(self, refresh: JoinRefresh, neighbour: Neighbour, now_s: float) -> None:
        """Renew the branches of a neighbour's joins; the reply names those that are unknown here, or no longer hold."""
        at, unknown = (neighbour.port, neighbour.mac), []
        for number in refresh.numbers:
            key = self._received.get(at, number)
            tree = None if key is None else self.trees.get(*key)
            branch = None if tree is None else tree.branches.get(at)
            if (
                tree is None
                or branch is None
                or branch.session != refresh.sender_session
                or branch.place != (tree.switch, tree.domain)
                or branch.proven_until_s <= now_s
            ):
                unknown.append(number)
                continue
            branch.expires_s = min(now_s + JOIN.lease_s, branch.proven_until_s)
            self._entries.install(tree)
        if unknown:
            self._joins.send_unknown(at, neighbour.name, tuple(unknown))

    def set_pace(self, pace: ReaderPace, neighbour: Neighbour) -> None:
        """Set the pace of an attached reader's branch, and bring the highest pace upstream."""
        tree = self.trees.get(pace.topic, pace.publisher)
        branch = None if tree is None else tree.branches.get((neighbour.port, neighbour.mac))
        if tree is not None and branch is not None and branch.pace != pace.pace:
            branch.pace = pace.pace
            self._entries.install(tree)
            self.upstream.restate(tree)

    def path_counts(self) -> dict[str, int]:
        """Return how many flows to readers here want two paths, by what they have.

        ``disjoint``: two paths without a shared link; ``shared``: both use a link that every path needs; ``single``:
        there is one path at most.
        """
        counts = dict.fromkeys(("disjoint", "shared", "single"), 0)
        for tree in (self.trees.get(*each) for each in self._paired):
            if tree is not None and any(branch.wants_pair for branch in tree.branches.values()):
                pair = self._pairs.present(tree.switch, tree.domain)
                counts["single" if pair is None else "shared" if pair.is_shared else "disjoint"] += 1
        return counts

    def neighbour_up(self, at: Downstream, now_s: float) -> None:
        """Repeat to a neighbour the joins that it received before its present session, whose state it has lost."""
        for tree in self.trees.all():
            if tree.upstream == at:
                self.upstream.ask(tree, now_s)

    def neighbour_lost(self, at: Downstream, now_s: float) -> None:
        """Remove every branch to a lost neighbour; backups of these branches replace them."""
        for topic in self._state.readers.topics_at(at):
            self.remove_reader(topic, at)
        for tree in self.trees.all():
            backup = tree.protection.get(at)
            if backup is not None:
                tree.branches[backup].active_until_s = now_s + _ACTIVE_S
            self._cut(tree, at)
        self._joins.neighbour_lost(at)

    def link_resized(self, port: int) -> None:
        """Send joins upstream for every tree whose MTU a changed link on a port affects."""
        for tree in self.trees.all():
            for (its, _), branch in tree.branches.items():
                if its == port:
                    branch.fit(self._state.neighbours.mtu_of(port))
            self.upstream.restate(tree)

    def invalidate_evidence(
        self,
        topic: Name,
        publisher: Name,
        at: Downstream,
        proves: Callable[[bytes], bool],
        until_s: float,
        now_s: float,
    ) -> None:
        """Let a branch whose evidence is invalid end at ``until_s``, unless another reader's evidence comes by then.

        The upstream neighbour receives another branch's evidence at once, or when such evidence arrives here.
        """
        for tree in self.trees.both(topic, publisher):
            branch = tree.branches.get(at)
            if branch is not None and not proves(branch.evidence):
                branch.expires_s = branch.proven_until_s = min(branch.expires_s, until_s)
            if not proves(tree.shown):
                tree.is_doubted, tree.renew_at_s = True, now_s
            self._entries.install(tree)

    def reroute(self, now_s: float) -> None:
        """Join again where the path to a publisher has changed."""
        for topic, publisher in list(self._paired):
            tree = self.trees.get(topic, publisher)
            if tree is None:
                self._paired.discard((topic, publisher))
            else:
                self._route_pair(tree, now_s)
        for tree in self.trees.all():
            if self.upstream.follow(tree, now_s):
                continue
            self._entries.reinstall(tree)
            if tree.path == 2 or tree.asked_route or tree.guide is not None:
                self.upstream.restate(tree)
        self._entries.reinstall_second()

    def handle_timer(self, now_s: float) -> None:
        """Remove readers whose lease has ended; prune and renew trees."""
        for topic, at in self._state.readers.expired(now_s):
            self.remove_reader(topic, at)
        pairs_s = self._pairs.get_timer()
        if pairs_s is not None and pairs_s <= now_s:
            self._pairs.handle_timer(now_s)
            self.reroute(now_s)
        for tree in self.trees.due(now_s):
            if self.trees.get(tree.topic, tree.publisher, tree.path) is tree:
                self._tree_due(tree, now_s)
        self._joins.handle_timer(now_s)

    def _tree_due(self, tree: Tree, now_s: float) -> None:
        for at in [at for at, branch in tree.branches.items() if branch.expires_s <= now_s]:
            self._cut(tree, at)
        if not tree.branches:
            self.trees.remove(tree)
            return
        rested = [
            branch
            for branch in tree.branches.values()
            if branch.active_until_s is not None and branch.active_until_s <= now_s
        ]
        for branch in rested:
            branch.active_until_s = None
        if rested:
            self._entries.install(tree)
            self.upstream.restate(tree)
        if tree.renew_at_s <= now_s:
            self.upstream.ask(tree, now_s, renews=True)
        if tree.former is not None and tree.former_until_s <= now_s:
            self.upstream.leave_former(tree)

    def get_timer(self) -> float | None:
        """Return the monotonic second of the next timer, or None."""
        tree_s = self.trees.next_event()
        times = (tree_s, self._pairs.get_timer(), self._state.readers.next_expiry(), self._joins.get_timer())
        next_s = min(time for time in times if time is not None)
        return None if next_s == float("inf") else next_s

    def _check_route(self, join: Join, neighbour: Neighbour) -> None:
        """Raise ``StatementError`` where a join must not have a route, or its route returns to here."""
        if not join.route and join.path == 1:
            return
        if join.backup_for != ZERO:
            raise StatementError(DropReason.MALFORMED, "a backup of a tree with a route")
        if join.route and neighbour.domain != self._state.policy.own:
            raise StatementError(DropReason.WRONG_DOMAIN, "a route through another domain")
        if {self._state.me, neighbour.name} & {link.name for link in join.route}:
            raise StatementError(DropReason.MALFORMED, "a route with a loop")

    def _route_pair(self, first: Tree, now_s: float) -> None:
        """Route the readers here that want two paths, and keep the second tree for as long as there is a pair.

        It follows the second tree; the caller follows the first one.
        """
        wanting = {at: branch for at, branch in first.branches.items() if branch.wants_pair}
        if first.path != 1 or not (wanting or self.trees.get(first.topic, first.publisher, 2)):
            return
        if wanting:
            self._paired.add((first.topic, first.publisher))
        else:
            self._paired.discard((first.topic, first.publisher))
        pair = self._pairs.to(first.switch, first.domain, now_s) if wanting else None
        for branch in wanting.values():
            branch.route = () if pair is None else pair.first
        second = self.trees.get(first.topic, first.publisher, 2)
        if second is not None:
            for at in [at for at, branch in second.branches.items() if branch.wants_pair and at not in wanting]:
                self._cut(second, at)
            if pair is None:  # copies are still under way on the path that remains, which the first tree takes over
                for branch in second.branches.values():
                    if branch.wants_pair:
                        branch.expires_s = min(branch.expires_s, now_s + OVERLAP_S)
        if pair is None:
            return
        second = self._tree(first.topic, first.publisher, first.allowed, 2)
        self.upstream.place_at(second, first.switch, first.domain, first.version, first.proof)
        second.allowed = first.allowed
        for at, branch in wanting.items():
            if not self._put_branch(second, at, replace(branch, route=pair.second)):
                self.drops[DropReason.QUOTA] += 1
        if second.branches:
            self._entries.install(second)
            if not self.upstream.follow(second, now_s):
                self.upstream.restate(second)

    def _tree(self, topic: Name, publisher: Name, allowed: frozenset[Name], path: int = 1) -> Tree:
        tree = self.trees.get(topic, publisher, path)
        if tree is None:
            tree = Tree(
                topic=topic,
                publisher=publisher,
                path=path,
                switch=self._state.me,
                domain=self._state.policy.own,
                allowed=allowed,
            )
            self.trees.put(tree)
        return tree

    def _put_branch(self, tree: Tree, at: Downstream, branch: Branch) -> bool:
        """Add or replace a branch; return False, and remove a bare tree, where its neighbour has too many."""
        if at not in tree.branches and not self._branch_shares.reserve(owner_of(at)):
            if not tree.branches:
                self.trees.remove(tree)
            return False
        tree.branches[at] = branch
        return True

    def _cut(self, tree: Tree, at: Downstream) -> None:
        if (branch := tree.branches.pop(at, None)) is not None:
            self._received.remove(at, branch.sequence)
            if at == tree.shown_of:
                tree.prove_at_s = 0.0  # the neighbour must not depend on the evidence of a reader that has left
            self._branch_shares.release(owner_of(at))
            self._after_cut(tree)

    def _after_cut(self, tree: Tree) -> None:
        if tree.branches:
            self._entries.install(tree)
            self.upstream.restate(tree)
            return
        self._entries.remove(tree)
        self.upstream.leave(tree)
        self.trees.remove(tree)


def _is_overtaken(join: Join, branch: Branch) -> bool:
    """Return whether a newer join or leave of the neighbour's same session came before."""
    return join.sender_session == branch.session and join.sequence <= branch.sequence
