"""Answers to the diagnostic request ``state``: what a switch or a RIB knows about one name.

Sans-I/O. Members of the own domain, and of domains that the policy names, get the facts. Another member gets them if it
holds a right on the name: it advertises, serves, calls or reads that name, as far as this node knows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from gdp.control.diagnostics import Diagnostics, Question
from gdp.crypto.statements import parse
from gdp.diagnosis.fields import to_fields
from gdp.errors import StoreError
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.state.node_state import RibState, SwitchState
from gdp.trust.advertisement import UnverifiedAdvertisement
from gdp.trust.domain import Policy

if TYPE_CHECKING:  # a node loads its own core alone, and facts when somebody asks
    from gdp.diagnosis.facts import RibFacts, SwitchFacts, TunnelFact
    from gdp.rib.state import RibCoreState

ASK: Final = "state"
_ROUTES_MAX: Final = 32
_TUNNELS_MAX: Final = 32


def answer_state(
    diagnostics: Diagnostics,
    policy: Policy,
    gather: Callable[[Question, Timestamps], object],
    holders: Callable[[Name, float], Collection[Name]],
) -> None:
    """Answer ``state`` from now on.

    Args:
        gather: returns the facts, a dataclass of ``gdp/diagnosis/facts.py``.
        holders: returns the nodes that hold a right on a name, as far as known, at a monotonic second.
    """

    def answer(question: Question, now: Timestamps) -> Mapping[str, object]:
        """Return the facts for who may know them; else nothing."""
        asker = question.asker
        if asker.domain not in policy.diagnostics and asker.name not in holders(question.name, now.mono_s):
            return {}
        try:
            return to_fields(gather(question, now))
        except StoreError:
            return {}

    diagnostics.register(ASK, answer, for_foreign=True)


def answer_for_switch(
    state: SwitchState, tunnels: Callable[[Timestamps], Sequence[Mapping[str, object]]] | None = None
) -> None:
    """Answer ``state`` for a switch.

    Args:
        tunnels: returns a row for each tunnel, as ``TunnelLinks.status``; None: the switch has none.
    """
    switch = state.switch

    def gather(question: Question, now: Timestamps) -> SwitchFacts:
        from gdp.state.switch_facts import switch_facts

        rows = () if tunnels is None else tunnels(now)
        return replace(switch_facts(state, question.name, now), tunnels=tuple(map(_tunnel, rows[:_TUNNELS_MAX])))

    def holders(name: Name, now_s: float) -> set[Name]:
        attached = {each.advertisement.node for each in switch.attached.named(name)}
        return attached | {place.advertiser for place in switch.resolver.cache.of(name, now_s)}

    answer_state(switch.diagnostics, state.policy, gather, holders)


def answer_for_rib(state: RibState) -> None:
    """Answer ``state`` for a RIB."""
    rib = state.host.rib.state

    def gather(question: Question, now: Timestamps) -> RibFacts:
        known = rib_facts(rib, question.name, now)
        return replace(known, waits=state.wait_facts(now.mono_s), is_attached=state.own_switch is not None)

    def holders(name: Name, now_s: float) -> set[Name]:
        watchers = {asker.name for asker in rib.outbox.watches.watchers(name, now_s)}
        return watchers | {route.advertiser for route in rib.store.routes(name)}

    answer_state(state.core.diagnostics, state.policy, gather, holders)


def rib_facts(rib: RibCoreState, name: Name, now: Timestamps) -> RibFacts:
    """Return what a RIB stores about a name, for a diagnosis. Raises ``StoreError``: the store is away."""
    from gdp.diagnosis.facts import RibFacts, RouteFact

    routes = [route for route in rib.store.routes(name) if route.expires_s > now.mono_s]
    here = {route.advertiser.to_text() for route in routes}
    return RibFacts(
        name=rib.identity.name.to_text(),
        domain=rib.identity.member.domain.to_text(),
        unix_s=now.unix_s,
        routes=tuple(
            RouteFact(
                advertiser=route.advertiser.to_text(),
                right=UnverifiedAdvertisement.from_statement(parse(route.advertisement)).right.value,
                switch=route.switch.to_text(),
                domain=route.domain.to_text(),
                lease_s=round(route.expires_s - now.mono_s, 1),
            )
            for route in routes[:_ROUTES_MAX]
        ),
        gone=tuple(each for each in rib.former.gone(name) if each.advertiser not in here),
        refused=rib.former.refused(name),
    )


def _tunnel(row: Mapping[str, object]) -> TunnelFact:
    from gdp.diagnosis.facts import TunnelFact

    age_s = row.get("handshake_age_s")
    return TunnelFact(
        peer=str(row.get("label") or row.get("peer")),
        device=str(row.get("device")),
        is_up=row.get("up") is True,
        handshake_age_s=float(age_s) if isinstance(age_s, int | float) else None,
        endpoint=str(row.get("endpoint") or ""),
    )
