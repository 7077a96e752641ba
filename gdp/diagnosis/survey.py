"""Survey: which nodes to ask about one name, round after round, and their answers.

Sans-I/O. The near proxy asks on behalf of the user, as the member that it is: its switch, then the RIB and the switches
that this one reaches, then their proxies.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Final, TypeVar

from gdp.diagnosis.facts import Facts, ProxyFacts, RibFacts, SwitchFacts, Unreachable
from gdp.diagnosis.fields import from_fields
from gdp.errors import StatementError
from gdp.names import ZERO, Name

ROLES: Final = ("switch", "rib", "switch", "proxy")  # of the rounds: first the near switch, later the others
_ASKED_MAX: Final = 24  # far nodes of one round
_GIVES: Final = ("publish", "serve")

_T = TypeVar("_T", ProxyFacts, SwitchFacts, RibFacts)


class Survey:
    """Answers about one name.

    Args:
        asked: the name as the user typed it.

    Attributes:
        unreachable: nodes that gave no facts.
    """

    def __init__(self, asked: str) -> None:
        self._asked = asked
        self._proxies: dict[str, ProxyFacts] = {}
        self._switches: dict[str, SwitchFacts] = {}
        self._ribs: dict[str, RibFacts] = {}
        self.unreachable: list[Unreachable] = []

    @property
    def near(self) -> ProxyFacts | None:
        """Return the proxy that asks, or None: it gave no facts."""
        return next((each for each in self._proxies.values() if each.is_near), None)

    @property
    def name(self) -> str:
        """Return the 256-bit name that is meant, as far as the near proxy knows one; else zeros."""
        if len(self._asked) == 2 * len(ZERO) and not self._asked.startswith("/"):
            return Name.from_text(self._asked).to_text()
        flows = [flow for each in self._proxies.values() for flow in each.flows if flow.overlay]
        flows.sort(key=lambda flow: (not flow.is_carried, flow.side != "import"))
        return flows[0].overlay if flows else ZERO.to_text()

    def targets(self, round_: int) -> list[str]:
        """Return the nodes to ask in a round, an index of ``ROLES``; no node twice."""
        near = self.near
        if near is None or not near.switch:
            return []
        switches, ribs = self._switches.values(), self._ribs.values()
        if round_ == 0:
            return self._new([near.switch])
        if round_ == 1:
            return self._new(sorted({each.rib for each in switches}))
        places = {place.switch for each in switches for place in each.locations}
        if round_ == 2:
            places |= {route.switch for each in ribs for route in each.routes}
            return self._new([*sorted(places), *sorted({each for switch in switches for each in switch.reaches})])
        givers = {route.advertiser for each in ribs for route in each.routes if route.right in _GIVES}
        givers |= {place.advertiser for each in switches for place in each.locations}
        return self._new([*sorted(givers), *sorted({each for switch in switches for each in switch.proxies})])

    def add(self, role: str, result: Mapping[str, object], *, is_near: bool = False) -> None:
        """Add the facts of a node; facts of another form count as none."""
        try:
            if role == "proxy":
                _put(self._proxies, ProxyFacts, result, is_near=is_near)
            elif role == "rib":
                _put(self._ribs, RibFacts, result, is_near=is_near)
            else:
                _put(self._switches, SwitchFacts, result, is_near=is_near)
        except StatementError:
            self.add_silent(role, "a node", "it answers in a form that this version does not read")

    def add_silent(self, role: str, where: str, why: str, *, is_down: bool = False) -> None:
        """Add a node that gave no facts; ``is_down``: it is known not to run."""
        self.unreachable.append(Unreachable(role=role, where=where, why=why, is_down=is_down))

    def facts(self) -> Facts:
        """Return everything that was learnt."""
        return Facts(
            asked=self._asked,
            proxies=tuple(sorted(self._proxies.values(), key=lambda each: not each.is_near)),
            switches=tuple(sorted(self._switches.values(), key=lambda each: not each.is_near)),
            ribs=tuple(self._ribs.values()),
            unreachable=tuple(self.unreachable),
        )

    def _new(self, targets: Iterable[str]) -> list[str]:
        known = {*self._proxies, *self._switches, *self._ribs}
        return [each for each in dict.fromkeys(targets) if each and each not in known][:_ASKED_MAX]


def _put(known: dict[str, _T], kind: type[_T], result: Mapping[str, object], *, is_near: bool) -> None:
    facts = from_fields(kind, result)
    known.setdefault(facts.name, replace(facts, is_near=is_near))
