"""Upstream side of multicast trees: which neighbour has a join of each tree, what it asks for, and when it is renewed.

Sans-I/O; time comes in as ``now_s`` (monotonic seconds). Source: the upstream state machine of PIM-SM (RFC 7761,
section 4.5.5).

A join is renewed several times at first, since one may be lost. Where nothing in a join has changed, its number renews
it, together with those of other trees (``joins.py``). A neighbour that does not know a number asks for the whole join.

Make before break: where the upstream neighbour changes because of a better path, the former one is left only after
``OVERLAP_S``; readers drop duplicates. Where the publisher has moved, the former one is left at once, for it may now
have to take its messages from here.

A tree that has settled requests a backup branch from its loop-free alternate (RFC 5286), as the secondary join of
RFC 7431. There a secondary tree carries copies all the time. Here it carries none until the switch that has both
branches loses the protected one, so no link carries a message twice.
"""

from __future__ import annotations

import math
from typing import Final

from gdp.control.join import JoinRefresh, Route
from gdp.control.neighbour import Neighbour
from gdp.crypto.certificates import Role
from gdp.errors import DropReason
from gdp.intervals import JOIN, JOIN_PROOF
from gdp.limits import JOINS_AGAIN_MAX, JOINS_LOST_FROM
from gdp.names import ZERO, Name
from gdp.requests import Backoff
from gdp.switch.forwarding_state import ForwardingState
from gdp.switch.joins import JoinSender
from gdp.switch.tree_entries import TreeEntries
from gdp.switch.trees import Downstream, JoinTerms, Tree

OVERLAP_S: Final = 0.3  # the former upstream neighbour is left so long after the join to the new one

_NEW_JOINS: Final = Backoff(0.1, JOIN.refresh_s)
_NEW_JOINS_MAX: Final = 4  # renewals of a new join, then one every JOIN.refresh_s
_SETTLED_JOINS: Final = 2  # renewals after which a tree has settled
_TICK_EARLY: Final = 0.25  # of an interval: the first renewal at a tick comes at least 0.75 intervals after the last


class UpstreamJoins:
    """The joins of one switch's multicast trees to their upstream neighbours.

    Args:
        entries: of the trees, installed again where copies may come from another side.
        joins: sends them.
    """

    def __init__(self, state: ForwardingState, entries: TreeEntries, joins: JoinSender) -> None:
        self._state = state
        self._entries = entries
        self._joins = joins
        self._is_leaf = state.identity.role is Role.LEAF
        self._phase = state.me[0] / 256  # of renewals, so that not all switches send theirs at once

    def place_at(self, tree: Tree, switch: Name, domain: Name, version: int, proof: bytes) -> None:
        """Update a tree's publisher location; if it is new, the upstream neighbour is left before another is joined."""
        if (tree.switch, tree.domain) != (switch, domain):
            self.leave_former(tree)
            tree.has_moved = True
        tree.switch, tree.domain, tree.version, tree.proof = switch, domain, version, proof

    def follow(self, tree: Tree, now_s: float) -> bool:
        """Join another upstream neighbour where the path to the publisher has changed; return whether it has."""
        upstream = self._next_hop(tree)
        if (None if upstream is None else upstream[0]) == tree.upstream:
            return False
        self.ask(tree, now_s)
        return True

    def assure(self, tree: Tree, now_s: float) -> None:
        """Make sure that the right upstream neighbour has a join with the present terms and valid evidence."""
        if self.follow(tree, now_s):
            return
        if tree.upstream is None or tree.is_doubted:
            self.ask(tree, now_s)
        else:
            self.restate(tree)

    def ask(self, tree: Tree, now_s: float, *, renews: bool = False) -> None:
        """Send a join upstream; ``renews``: its number suffices if nothing in it has changed."""
        upstream = self._next_hop(tree)
        tree.renew_at_s = self._tick_s(JOIN.refresh_s, now_s)
        if (None if upstream is None else upstream[0]) != tree.upstream:
            self._part_from_above(tree, now_s, keep=upstream is not None)
            if upstream is not None:
                tree.upstream, tree.upstream_name = upstream
                tree.followed = () if tree.guide is None else tree.guide.route
                if tree.backup is not None and tree.backup[0] == tree.upstream:
                    tree.backup = None  # an ordinary join replaces it
            self._entries.install(tree)
        if upstream is None and self._state.paths.leads_through_leaf(tree.switch, tree.domain):
            self._entries.drops[DropReason.THROUGH_LEAF] += 1
        if upstream is None or not tree.is_wanted_below:
            return
        has_settled = tree.joins >= _SETTLED_JOINS
        if tree.joins < _NEW_JOINS_MAX:
            tree.joins += 1
            tree.renew_at_s = now_s + _NEW_JOINS.pause_s(tree.joins)
        elif self._state.neighbours.loss_between(upstream[0][0], upstream[1]) >= JOINS_LOST_FROM:
            tree.renew_at_s = self._tick_s(JOIN.refresh_s / 4, now_s)
        is_proof_due = not renews or now_s >= tree.prove_at_s
        if is_proof_due:  # spread, so that the whole joins of many trees do not leave together
            tree.prove_at_s = now_s + JOIN_PROOF.refresh_s * (1 + tree.topic[0] / 255) / 2
        self._show(tree, renews=not is_proof_due)
        if has_settled and self._state.paths.has_alternates:
            self._ask_for_backup(tree, renews=not is_proof_due)
        if has_settled and tree.former_ports:
            tree.former_ports.clear()
            self._entries.install(tree)

    def restate(self, tree: Tree) -> None:
        """Send a join upstream at once if one of its terms has changed, such as the MTU."""
        if tree.upstream is None:
            return
        if tree.asked_route != self._route_onwards(tree):
            tree.joins, tree.renew_at_s = 0, 0.0  # due at once, and repeated like the first join
            return
        sent, terms = tree.sent.get(tree.upstream), self._upstream_terms(tree)
        if terms is not None and (sent is None or sent.terms != terms):
            self._show(tree)

    def leave_former(self, tree: Tree) -> None:
        """Leave the former upstream neighbour, if there still is one."""
        former, tree.former = tree.former, None
        self._send_leave(tree, former)

    def leave(self, tree: Tree) -> None:
        """Leave every upstream neighbour of a tree that has no branch left."""
        self.leave_former(tree)
        self._leave_backup(tree)
        self._leave(tree)

    def join_unknown(self, reply: JoinRefresh, neighbour: Neighbour, now_s: float) -> None:
        """Send whole joins of which a neighbour does not know the numbers; of many, the others come later."""
        at = neighbour.port, neighbour.mac
        for count, tree in enumerate(self._joins.find_unknown(at, reply.numbers)):
            tree.unknown += 1
            pause_s = _NEW_JOINS.pause_s(tree.unknown)
            if count < JOINS_AGAIN_MAX:
                del tree.sent[at]
                if tree.upstream == at:
                    self.ask(tree, now_s)
                elif tree.backup is not None and tree.backup[0] == at:
                    self._ask_for_backup(tree)
            tree.renew_at_s = min(tree.renew_at_s, now_s + pause_s)

    def _next_hop(self, tree: Tree) -> tuple[Downstream, Name] | None:
        """Return port, address and name of the next hop towards the publisher; None when there is no path now."""
        if tree.switch == self._state.me:
            attachment = self._state.attached.get(tree.topic, tree.publisher)
            return None if attachment is None else ((attachment.port, attachment.mac), tree.publisher)
        link = tree.next_link
        if link is not None:
            neighbour = self._state.neighbours.over_link(*link)
            if neighbour is not None:
                return (neighbour.port, neighbour.mac), neighbour.name
            if tree.path == 2:
                return None  # the reader's switch chooses another route; the first tree carries every message
        path = self._state.paths.to_switch(tree.switch, tree.domain, tree.allowed)
        neighbour = None if path is None else self._state.neighbours.cheapest(path.first)
        return None if neighbour is None else ((neighbour.port, neighbour.mac), neighbour.name)

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

    def _ask_for_backup(self, tree: Tree, *, renews: bool = False) -> None:
        """Request a backup branch from the neighbour that could replace the best one, or leave it."""
        other = self._alternate(tree)
        if other != tree.backup:
            self._leave_backup(tree)
            tree.backup = other
            self._entries.install(tree)
        evidence = self._evidence(tree)
        if other is not None and evidence:
            at, name = other
            mtu = min(tree.mtu, self._state.neighbours.mtu_of(at[0]))
            terms = self._joins.terms(tree, at, name, mtu, self._state.me)
            if not (renews and self._joins.add_renewal(tree, at, terms)):
                self._joins.send_join(tree, at, name, terms, evidence)

    def _alternate(self, tree: Tree) -> tuple[Downstream, Name] | None:
        """Return where to request a backup branch: the loop-free alternate towards the publisher, or None.

        It never leaves the switch's domain, because the path choice of other domains is unknown. A tree that follows a
        route has its second path instead.
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

    def _leave_backup(self, tree: Tree) -> None:
        backup, tree.backup = tree.backup, None
        self._send_leave(tree, backup)

    def _tick_s(self, interval_s: float, now_s: float) -> float:
        """Return when trees are renewed that were renewed now: all at the same ticks, so that they share a refresh."""
        return (math.floor(now_s / interval_s - self._phase + _TICK_EARLY) + 1 + self._phase) * interval_s

    def _mtu_over(self, tree: Tree, port: int) -> int:
        """Return the MTU for a join over a port; the publisher gets that of both trees, since it sends one size."""
        trees = self._state.trees.both(tree.topic, tree.publisher) if tree.switch == self._state.me else (tree,)
        return min(self._state.neighbours.mtu_of(port), *(each.mtu for each in trees if each.branches))

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

    def _part_from_above(self, tree: Tree, now_s: float, *, keep: bool) -> None:
        """Leave the upstream neighbour: at once, or after a while where only the path to the same location changed."""
        self.leave_former(tree)
        if keep and tree.upstream is not None and tree.upstream_name is not None and self._is_loop_free(tree):
            tree.former, tree.former_until_s = (tree.upstream, tree.upstream_name), now_s + OVERLAP_S
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

    def _leave(self, tree: Tree) -> None:
        at, name = tree.upstream, tree.upstream_name
        tree.upstream = tree.upstream_name = None
        self._send_leave(tree, None if at is None or name is None else (at, name))

    def _send_leave(self, tree: Tree, neighbour: tuple[Downstream, Name] | None) -> None:
        """Leave a neighbour, if there is one; the present upstream neighbour keeps its branch."""
        if neighbour is not None:
            at, name = neighbour
            tree.former_ports.add(at[0])
            if at != tree.upstream:
                self._joins.send_leave(tree, at, name)
