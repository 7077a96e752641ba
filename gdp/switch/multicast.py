"""Multicast trees of a switch: joins and prunes from downstream, joins upstream, and the table entries between.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: after PIM-SM (RFC 7761).

A reader's advertisement and each known publisher of its topic make a tree. So do a server with each client, and a
client with each server; here they are called reader and publisher. While a branch stands, a switch renews its join to
the next switch towards the publisher. It joins another one at once when the path changes. A join is renewed several
times at first, since one may be lost. A join carries the smallest MTU downstream, so it is sent again at once when that
changes: a reader came or left, or a link became narrower or wider.

Where nothing in a join has changed, its number renews it, together with those of other trees (``joins.py``). A
neighbour that does not know a number asks for the whole join.

Make before break: where the upstream neighbour changes because of a better path, the former one is left only after
``_OVERLAP_S``; readers drop duplicates. Where the publisher has moved, the former one is left at once, for it may now
have to take its messages from here.

A reader and a publisher that both ask for two paths get two trees (``docs/explanation/two-paths.md``). The reader's
switch chooses the routes of both (``path_pairs.py``), and the joins bring them along.

A tree that has settled requests a backup branch from its loop-free alternate (``backups.py``). Where both paths part,
the data plane uses the backup as soon as the port of the protected branch is down. The branch itself is lost a moment
later. The backup then counts as a branch for ``_ACTIVE_S``, in which the downstream switch joins again.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from gdp.control.join import Join, Route
from gdp.control.join_refresh import JoinRefresh
from gdp.control.neighbour import Neighbour
from gdp.crypto.certificates import Role
from gdp.errors import DropReason, StatementError
from gdp.frame.codec import second_path_key
from gdp.intervals import JOIN, JOIN_PROOF
from gdp.limits import JOINS_AGAIN_MAX, JOINS_LOST_FROM, TREES_MAX
from gdp.message.shares import Shares
from gdp.names import ZERO, Name
from gdp.requests import Backoff
from gdp.switch.backups import Backups
from gdp.switch.forwarding_state import ForwardingState
from gdp.switch.joins import JoinSender, ReceivedJoins
from gdp.switch.name_cache import Location
from gdp.switch.path_pairs import PathPairs
from gdp.switch.trees import Branch, Downstream, JoinTerms, Tree, owner_of
from gdp.trust.advertisement import Advertisement
from gdp.trust.right import HEARS

__all__ = ["MulticastTrees"]

_NEW_JOINS: Final = Backoff(0.1, JOIN.refresh_s)
_NEW_JOINS_MAX: Final = 4  # renewals of a new join, then one every JOIN.refresh_s
_SETTLED_JOINS: Final = 2  # renewals after which a tree has settled
_TICK_EARLY: Final = 0.25  # of an interval: the first renewal at a tick comes at least 0.75 intervals after the last
_OVERLAP_S: Final = 0.3  # the former upstream neighbour is left so long after the join to the new one
_ACTIVE_S: Final = 1.0  # for which a backup replaces a branch that was lost


class MulticastTrees:
    """The multicast trees of one switch.

    Args:
        first_sequence: of our joins.
    """

    def __init__(self, state: ForwardingState, first_sequence: int) -> None:
        self._state = state
        self._is_leaf = state.identity.role is Role.LEAF
        self._pairs = PathPairs(state.me, state.paths)
        self._backups = Backups(state)
        self._branch_shares = Shares(TREES_MAX)
        self._paired: set[tuple[Name, Name]] = set()  # topics and publishers that readers here want over two paths
        self._second: dict[Name, dict[Name, Tree]] = {}  # trees of second copies, by publisher and topic
        self.trees = state.trees
        self._joins = JoinSender(state, first_sequence)
        self._received = ReceivedJoins()
        self._phase = state.me[0] / 256  # of renewals, so that not all switches send theirs at once
        self.drops: Counter[DropReason] = Counter()

    def add_reader(self, advertisement: Advertisement, at: Downstream, locations: list[Location], now_s: float) -> bool:
        """Add the verified advertisement of an attached reader; return whether it is the name's first here.

        Raises:
            StatementError: QUOTA, the node reads too many topics.
        """
        is_first = self._state.readers.put(advertisement, at, now_s)
        for location in locations:
            self.publisher_found(location, now_s)
        return is_first

    def remove_reader(self, topic: Name, at: Downstream) -> bool:
        """Remove a reader; return whether the topic has none left here."""
        is_last = self._state.readers.remove(topic, at)
        for tree in self.trees.of_topic(topic):
            self._cut(tree, at)
        return is_last

    def publisher_found(self, location: Location, now_s: float) -> None:
        """Join a publisher of a topic that has readers here, or follow it."""
        for at, reader in self._state.readers.of(location.name).items():
            if (
                reader.advertisement.node == location.advertiser
                or HEARS[reader.advertisement.right] is not location.right
            ):
                continue  # a publisher does not receive its own messages
            allowed = (self._state.policy.transit & location.transit) | {self._state.policy.own, location.domain}
            tree = self._tree(location.name, location.advertiser, allowed)
            if location.sequence >= tree.version:
                self._place_at(tree, location.switch, location.domain, location.sequence, location.advertisement)
                tree.allowed = allowed
            branch = Branch(
                expires_s=reader.expires_s,
                mtu=self._state.outbox.mtu_of(at[0]),
                evidence=reader.advertisement.wire,
                wants_pair=reader.advertisement.paths > 1 and location.proof is not None and location.proof.paths > 1,
            )
            if not self._put_branch(tree, at, branch):
                self.drops[DropReason.QUOTA] += 1
                continue
            self._route_pair(tree, now_s)
            self._install(tree)
            self._assure(tree, now_s)

    def publisher_attached(self, advertisement: Advertisement, now_s: float) -> None:
        """Handle a publisher's advertisement of its topic here: trees that pass here join it directly at once."""
        for tree in self.trees.both(advertisement.name, advertisement.node):
            version = max(advertisement.sequence, tree.version)
            self._place_at(tree, self._state.me, self._state.policy.own, version, advertisement.wire)
            tree.renew_at_s = now_s
            self._route_pair(tree, now_s)

    def publisher_moved(self, location: Location, now_s: float) -> None:
        """Reroute a publisher's tree to its new location, if it passes here and its readers allow the path there."""
        for tree in self.trees.both(location.name, location.advertiser):
            if location.sequence >= tree.version and location.domain in tree.allowed:
                self._place_at(tree, location.switch, location.domain, location.sequence, location.advertisement)
                self._route_pair(tree, now_s)
                if tree.branches and not self._follow(tree, now_s):
                    self._restate(tree)

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

    def reader_moved(self, location: Location) -> bool:
        """Remove a reader that is attached elsewhere now; return whether the topic has none left here."""
        for at, reader in list(self._state.readers.of(location.name).items()):
            if reader.advertisement.node == location.advertiser and reader.advertisement.sequence < location.sequence:
                return self.remove_reader(location.name, at)
        return False

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
            self._leave_former(tree)  # it takes the messages from here now
        is_behind = join.version < tree.version
        if join.version >= tree.version:
            self._place_at(tree, join.switch, join.domain, join.version, join.proof)
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
        )
        branch.fit(self._state.outbox.mtu_of(neighbour.port))
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
        self._install(tree)
        self._assure(tree, now_s)
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
            self._install(tree)
        if unknown:
            self._joins.send_unknown(at, neighbour.name, tuple(unknown))

    def join_unknown(self, reply: JoinRefresh, neighbour: Neighbour, now_s: float) -> None:
        """Send whole joins of which a neighbour does not know the numbers; of many, the others come later."""
        at = neighbour.port, neighbour.mac
        for count, tree in enumerate(self._joins.find_unknown(at, reply.numbers)):
            tree.unknown += 1
            pause_s = _NEW_JOINS.pause_s(tree.unknown)
            if count < JOINS_AGAIN_MAX:
                del tree.sent[at]
                if tree.upstream == at:
                    self._ask_upstream(tree, now_s)
                elif tree.backup is not None and tree.backup[0] == at:
                    self._ask_for_backup(tree)
            tree.renew_at_s = min(tree.renew_at_s, now_s + pause_s)

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
                self._ask_upstream(tree, now_s)

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
                    branch.fit(self._state.outbox.mtu_of(port))
            self._restate(tree)

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
            self._install(tree)

    def reroute(self, now_s: float) -> None:
        """Join again where the path to a publisher has changed."""
        for topic, publisher in list(self._paired):
            tree = self.trees.get(topic, publisher)
            if tree is None:
                self._paired.discard((topic, publisher))
            else:
                self._route_pair(tree, now_s)
        for tree in self.trees.all():
            if self._follow(tree, now_s):
                continue
            if self._backups.protection(tree) != tree.protection:
                self._install(tree)
            if tree.path == 2 or tree.asked_route or tree.guide is not None:
                self._restate(tree)
        for publisher in list(self._second):
            self._install_to_publisher(publisher)

    def handle_timer(self, now_s: float) -> list[Name]:
        """Prune and renew trees; return the topics that lost their last reader here."""
        orphaned = [topic for topic, at in self._state.readers.expired(now_s) if self.remove_reader(topic, at)]
        pairs_s = self._pairs.get_timer()
        if pairs_s is not None and pairs_s <= now_s:
            self._pairs.handle_timer(now_s)
            self.reroute(now_s)
        for tree in self.trees.due(now_s):
            if self.trees.get(tree.topic, tree.publisher, tree.path) is tree:
                self._tree_due(tree, now_s)
        self._joins.handle_timer(now_s)
        return orphaned

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
            self._install(tree)
            self._restate(tree)
        if tree.renew_at_s <= now_s:
            self._ask_upstream(tree, now_s, renews=True)
        if tree.former is not None and tree.former_until_s <= now_s:
            self._leave_former(tree)

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
                        branch.expires_s = min(branch.expires_s, now_s + _OVERLAP_S)
        if pair is None:
            return
        second = self._tree(first.topic, first.publisher, first.allowed, 2)
        self._place_at(second, first.switch, first.domain, first.version, first.proof)
        second.allowed = first.allowed
        for at, branch in wanting.items():
            if not self._put_branch(second, at, replace(branch, route=pair.second)):
                self.drops[DropReason.QUOTA] += 1
        if second.branches:
            self._install(second)
            if not self._follow(second, now_s):
                self._restate(second)

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

    def _install(self, tree: Tree) -> None:
        tree.protection = self._backups.protection(tree)
        hops = tree.hops(self._state.outbox.mac_of())
        if not self._state.table.install(tree.key, hops, tree.expires_s(), tree.sides):
            self.drops[DropReason.QUOTA] += 1
        if tree.path == 2:
            self._second.setdefault(tree.publisher, {})[tree.topic] = tree
            self._install_to_publisher(tree.publisher)

    def _uninstall(self, tree: Tree) -> None:
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
        macs, key = self._state.outbox.mac_of(), second_path_key(publisher)
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
        first = self.trees.get(second.topic, second.publisher)
        if first is None or first.upstream is None or first.upstream_name != second.upstream_name:
            return second.upstream
        ordinary = self._state.neighbours.cheapest(first.upstream_name) if first.upstream_name is not None else None
        is_taken = ordinary is not None and (ordinary.port, ordinary.mac) == second.upstream
        return first.upstream if is_taken else second.upstream

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
            self._install(tree)
            self._restate(tree)
            return
        self._uninstall(tree)
        self._leave_former(tree)
        self._leave_backup(tree)
        self._leave(tree)
        self.trees.remove(tree)

    def _upstream_queries(self, tree: Tree) -> tuple[int, bytes, Name] | None:
        """Return port, address and name of the next hop towards the publisher; None when there is no path now."""
        if tree.switch == self._state.me:
            attachment = self._state.attached.get(tree.topic, tree.publisher)
            return None if attachment is None else (attachment.port, attachment.mac, tree.publisher)
        link = tree.next_link
        if link is not None:
            neighbour = self._state.neighbours.over_link(*link)
            if neighbour is not None:
                return neighbour.port, neighbour.mac, neighbour.name
            if tree.path == 2:
                return None  # the reader's switch chooses another route; the first tree carries every message
        path = self._state.paths.to_switch(tree.switch, tree.domain, tree.allowed)
        neighbour = None if path is None else self._state.neighbours.cheapest(path.first)
        return None if neighbour is None else (neighbour.port, neighbour.mac, neighbour.name)

    def _follow(self, tree: Tree, now_s: float) -> bool:
        """Join another upstream neighbour where the path to the publisher has changed; return whether it has."""
        upstream = self._upstream_queries(tree)
        if (None if upstream is None else upstream[:2]) == tree.upstream:
            return False
        self._ask_upstream(tree, now_s)
        return True

    def _tick_s(self, interval_s: float, now_s: float) -> float:
        """Return when trees are renewed that were renewed now: all at the same ticks, so that they share a refresh."""
        return (math.floor(now_s / interval_s - self._phase + _TICK_EARLY) + 1 + self._phase) * interval_s

    def _assure(self, tree: Tree, now_s: float) -> None:
        """Make sure that the right upstream neighbour has a join with the present terms and valid evidence."""
        if self._follow(tree, now_s):
            return
        if tree.upstream is None or tree.is_doubted:
            self._ask_upstream(tree, now_s)
        else:
            self._restate(tree)

    def _ask_upstream(self, tree: Tree, now_s: float, *, renews: bool = False) -> None:
        """Send a join upstream; ``renews``: its number suffices if nothing in it has changed."""
        upstream = self._upstream_queries(tree)
        tree.renew_at_s = self._tick_s(JOIN.refresh_s, now_s)
        if (None if upstream is None else upstream[:2]) != tree.upstream:
            self._part_from_above(tree, now_s, keep=upstream is not None)
            if upstream is not None:
                tree.upstream, tree.upstream_name = upstream[:2], upstream[2]
                tree.followed = () if tree.guide is None else tree.guide.route
                if tree.backup is not None and tree.backup[0] == tree.upstream:
                    tree.backup = None  # an ordinary join replaces it
            self._install(tree)
        if upstream is None and self._state.paths.leads_through_leaf(tree.switch, tree.domain):
            self.drops[DropReason.THROUGH_LEAF] += 1
        if upstream is None or not tree.is_wanted_below:
            return
        has_settled = tree.joins >= _SETTLED_JOINS
        if tree.joins < _NEW_JOINS_MAX:
            tree.joins += 1
            tree.renew_at_s = now_s + _NEW_JOINS.pause_s(tree.joins)
        elif self._state.neighbours.loss_between(upstream[0], upstream[2]) >= JOINS_LOST_FROM:
            tree.renew_at_s = self._tick_s(JOIN.refresh_s / 4, now_s)
        is_proof_due = not renews or now_s >= tree.prove_at_s
        if is_proof_due:  # spread, so that the whole joins of many trees do not leave together
            tree.prove_at_s = now_s + JOIN_PROOF.refresh_s * (1 + tree.topic[0] / 255) / 2
        self._show(tree, renews=not is_proof_due)
        if has_settled and self._state.paths.has_alternates:
            self._ask_for_backup(tree, renews=not is_proof_due)
        if has_settled and tree.former_ports:
            tree.former_ports.clear()
            self._install(tree)

    def _restate(self, tree: Tree) -> None:
        """Send a join upstream at once if one of its terms has changed, such as the MTU."""
        if tree.upstream is None:
            return
        if tree.asked_route != self._route_onwards(tree):
            tree.joins, tree.renew_at_s = 0, 0.0  # due at once, and repeated like the first join
            return
        sent, terms = tree.sent.get(tree.upstream), self._upstream_terms(tree)
        if terms is not None and (sent is None or sent.terms != terms):
            self._show(tree)

    def _mtu_over(self, tree: Tree, port: int) -> int:
        """Return the MTU for a join over a port; the publisher gets that of both trees, since it sends one size."""
        trees = self.trees.both(tree.topic, tree.publisher) if tree.switch == self._state.me else (tree,)
        return min(self._state.outbox.mtu_of(port), *(each.mtu for each in trees if each.branches))

    def _ask_for_backup(self, tree: Tree, *, renews: bool = False) -> None:
        """Request a backup branch from the neighbour that could replace the best one, or leave it."""
        other = self._backups.upstream(tree)
        if other != tree.backup:
            self._leave_backup(tree)
            tree.backup = other
            self._install(tree)
        evidence = self._evidence(tree)
        if other is not None and evidence:
            at, name = other
            mtu = min(tree.mtu, self._state.outbox.mtu_of(at[0]))
            terms = self._joins.terms(tree, at, name, mtu, self._state.me)
            if not (renews and self._joins.add_renewal(tree, at, terms)):
                self._joins.send_join(tree, at, name, terms, evidence)

    def _leave_backup(self, tree: Tree) -> None:
        if tree.backup is not None:
            (at, name), tree.backup = tree.backup, None
            tree.former_ports.add(at[0])
            if at != tree.upstream:
                self._joins.send_leave(tree, at, name)

    def _show(self, tree: Tree, *, renews: bool = False) -> None:
        """Send a join upstream, with the evidence of a downstream reader, or renew it."""
        tree.asked_route = self._route_onwards(tree)
        evidence, terms = self._evidence(tree), self._upstream_terms(tree)
        may_renew = bool(evidence) and renews and not tree.is_doubted
        if may_renew and tree.upstream is not None and self._joins.add_renewal(tree, tree.upstream, terms):
            return
        tree.is_doubted = tree.is_doubted and evidence == tree.shown
        tree.shown = evidence
        tree.shown_of = next((at for at, branch in tree.branches.items() if branch.evidence == evidence), None)
        if evidence and tree.upstream is not None and tree.upstream_name is not None:
            self._joins.send_join(tree, tree.upstream, tree.upstream_name, terms, evidence)

    def _upstream_terms(self, tree: Tree) -> JoinTerms | None:
        """Return what a join upstream asks for now; None where none may be sent."""
        if tree.upstream is None or tree.upstream_name is None:
            return None
        backup_for = tree.backup_for or ZERO
        if backup_for != ZERO and self._state.paths.domain_of(tree.upstream_name) != self._state.policy.own:
            return None  # backups are internal to a domain
        mtu = self._mtu_over(tree, tree.upstream[0])
        return self._joins.terms(tree, tree.upstream, tree.upstream_name, mtu, backup_for, tree.asked_route)

    def _route_onwards(self, tree: Tree) -> Route:
        """Return the route for the upstream neighbour: what remains after the link to it."""
        guide = tree.guide
        if guide is None or tree.switch == self._state.me:
            return ()
        neighbour = self._state.neighbours.over_link(*guide.route[0])
        leads_there = neighbour is not None and (neighbour.port, neighbour.mac) == tree.upstream
        return guide.route[1:] if leads_there else ()

    def _evidence(self, tree: Tree) -> bytes:
        """Return the advertisement to send upstream; of a leaf only an attached reader's, empty where none is.

        A neighbour may still take a tree from a leaf that its publisher has just left. No join is sent for that
        neighbour.
        """
        if not self._is_leaf or tree.switch == self._state.me:
            return tree.evidence
        if (guide := tree.guide) is not None and guide.wants_pair:
            return guide.evidence
        own = self._state.readers.of(tree.topic).keys() & tree.branches.keys()
        return max((tree.branches[at] for at in own), key=lambda each: each.expires_s).evidence if own else b""

    def _place_at(self, tree: Tree, switch: Name, domain: Name, version: int, proof: bytes) -> None:
        """Update a tree's publisher location; if it is new, the upstream neighbour is left before another is joined."""
        if (tree.switch, tree.domain) != (switch, domain):
            self._leave_former(tree)
            tree.has_moved = True
        tree.switch, tree.domain, tree.version, tree.proof = switch, domain, version, proof

    def _part_from_above(self, tree: Tree, now_s: float, *, keep: bool) -> None:
        """Leave the upstream neighbour: at once, or after a while where only the path to the same location changed."""
        self._leave_former(tree)
        if keep and tree.upstream is not None and tree.upstream_name is not None and self._is_loop_free(tree):
            tree.former, tree.former_until_s = (tree.upstream, tree.upstream_name), now_s + _OVERLAP_S
            tree.upstream = tree.upstream_name = None
        else:
            self._leave(tree)
        tree.joins, tree.unknown, tree.has_moved = 0, 0, False

    def _is_loop_free(self, tree: Tree) -> bool:
        """Return whether the upstream neighbour, no longer the best, cannot take the messages from here itself.

        Source: RFC 5286, inequality 3 (a downstream neighbour is nearer to the destination than we are). No switch
        takes other nodes' messages from a leaf.
        """
        if tree.has_moved or tree.upstream_name is None:
            return False
        if tree.path == 2 or tree.followed or tree.guide is not None:
            return self._state.readers.of(tree.topic).keys() >= tree.branches.keys()  # it is the end of its route
        if self._is_leaf:
            return True
        own = self._state.paths.to_switch(tree.switch, tree.domain, tree.allowed)
        its = self._state.paths.distance_from(tree.upstream_name, tree.switch, tree.domain, tree.allowed)
        return own is not None and its is not None and its < own.distance

    def _leave_former(self, tree: Tree) -> None:
        if tree.former is not None:
            (at, name), tree.former = tree.former, None
            tree.former_ports.add(at[0])
            if at != tree.upstream:
                self._joins.send_leave(tree, at, name)

    def _leave(self, tree: Tree) -> None:
        if tree.upstream is not None and tree.upstream_name is not None:
            tree.former_ports.add(tree.upstream[0])
            self._joins.send_leave(tree, tree.upstream, tree.upstream_name)
        tree.upstream = tree.upstream_name = None


def _is_overtaken(join: Join, branch: Branch) -> bool:
    """Return whether a newer join or leave of the neighbour's same session came before."""
    return join.sender_session == branch.session and join.sequence <= branch.sequence
