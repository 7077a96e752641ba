"""Answers of a switch to diagnostic requests: the path and the trees of a name here, and where the name is advertised.

Sans-I/O.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from gdp.control.diagnostic_bodies import RightEvidence
from gdp.control.diagnostics import Diagnostics, Question
from gdp.crypto.certificates import Role
from gdp.crypto.schema import NAME_OR_ZERO, Keyed
from gdp.errors import DropReason, StatementError
from gdp.frame.pace import kbit_s_of
from gdp.names import ZERO, Name
from gdp.sansio import Timestamps
from gdp.switch.forwarding_state import ForwardingState
from gdp.trust.right import Right

_MAC_BYTES: Final = 6
_END: Final = Keyed("t", NAME_OR_ZERO, absent=None)
_PUBLISHER: Final = Keyed("p", NAME_OR_ZERO, absent=ZERO)


class DiagnosticAnswers:
    """The answers of one switch.

    Args:
        wake: called when a query to the RIB is due.

    Attributes:
        port_name: returns the device of a port; the I/O layer sets it.
    """

    def __init__(self, state: ForwardingState, diagnostics: Diagnostics, wake: Callable[[], None]) -> None:
        self._state = state
        self._wake = wake
        self.port_name: Callable[[int], str] = str
        diagnostics.register("trace", self.trace)
        diagnostics.register("resolve", self.resolve)

    def trace(self, question: Question, now: Timestamps) -> Mapping[str, object]:
        """Return the link that the request came by, the next one towards its target, and the tree branches of its name.

        The body may name one publisher (``p``); without it the branches of all publishers come. It may also name the
        end of the path (``t``), where that is not the member that was asked. A proxy whose
        request shows no right on the name gets the reason (``w``) instead of branches. A branch that gets only what
        its path carries states that rate (``kbit_s``).
        """
        result: dict[str, object] = {}
        if question.port is not None:
            result["in"] = self._link(question.port, question.mac)
        end = _END.read(question.body) or question.target
        entries = self._state.table.entries
        hops = entries.get(end + question.asker.name) or entries.get(end)
        if end != self._state.me and hops:
            result["out"] = self._link(hops[0][0], hops[0][1][:_MAC_BYTES])
        try:
            self._check_right(question, now)
        except StatementError as error:
            return result | {"w": error.reason.label}
        wanted = _PUBLISHER.read(question.body)
        result["branches"] = [
            {"p": tree.publisher, **self._link(port, mac), **_rate(branch.pace)}
            for tree in self._state.trees.of_topic(question.name)
            if wanted in (ZERO, tree.publisher) and tree.path == 1
            for (port, mac), branch in sorted(tree.branches.items())
            if branch.is_active and (port, mac) != tree.upstream
        ]
        return result

    def _check_right(self, question: Question, now: Timestamps) -> None:
        """Return if the asker carries traffic, or shows a right on the name. Raises ``StatementError``: neither."""
        body, name, asker = question.body, question.name, question.asker
        if asker.role is not Role.PROXY or name == ZERO:
            return
        if "right" not in body:
            raise StatementError(DropReason.NOT_DELEGATED, "no right on the name")
        shown = RightEvidence.from_fields(body)
        shown.subject.expect(name)
        self._state.verifier.verify_right(shown.subject, shown.right, shown.chain, asker, now.unix_s)

    def resolve(self, question: Question, now: Timestamps) -> Mapping[str, object] | None:
        """Return who advertises a name, for a node that is attached here; None: the RIB is being queried."""
        if not question.is_neighbour:
            return {"places": []}
        me, paths = self._state.me, self._state.paths
        locations: dict[Name, Mapping[str, object]] = {
            each.advertisement.node: {
                "node": each.advertisement.node,
                "right": each.advertisement.right.value,
                "switch": me,
                **({"cost": 0} if each.advertisement.right is Right.SERVE else {}),
            }
            for each in self._state.attached.named(question.name)
        }
        if paths.is_switch(question.name) or paths.is_rib(question.name) or question.name == me:
            locations[question.name] = {"node": question.name, "right": Right.ATTACH.value}  # link states name it
        found = self._state.resolver.resolve_any(question.name, now.mono_s)
        if found is None:
            self._wake()
            if not locations:
                return None
        for location in found if isinstance(found, list) else ():
            known = {
                "node": location.advertiser,
                "right": location.right.value,
                "switch": location.switch,
                "domain": location.domain,
                **({"cost": self._state.cost_of(location)} if location.right is Right.SERVE else {}),
            }
            locations.setdefault(location.advertiser, known)
        return {"places": [locations[node] for node in sorted(locations)]}

    def _link(self, port: int, mac: bytes) -> dict[str, object]:
        """Return the link to a neighbour: its device, and who is at the other end, as far as known."""
        link: dict[str, object] = {"port": self.port_name(port)}
        neighbour = self._state.neighbours.neighbour_at(port, mac)
        if neighbour is not None:
            rtt_s = self._state.neighbours.ports[port].quality_of(neighbour.name).rtt.srtt_s
            link |= {"to": neighbour.name, "role": neighbour.role.value, "cost": neighbour.cost}
            if neighbour.member is not None:
                link["label"] = neighbour.member.label
            if rtt_s is not None:
                link["rtt_us"] = round(1e6 * rtt_s)
        return link


def _rate(pace: int) -> Mapping[str, object]:
    return {} if (kbit_s := kbit_s_of(pace)) is None else {"kbit_s": kbit_s}
