"""Facts of a switch about one name: where its advertisers are, and its trees here."""

from __future__ import annotations

from typing import Final

from gdp.crypto.certificates import Role
from gdp.diagnosis.facts import LocationFact, SwitchFacts
from gdp.names import Name
from gdp.sansio import Timestamps
from gdp.state.node_state import SwitchState

_LOCATIONS_MAX: Final = 32
_SWITCHES_MAX: Final = 64


def switch_facts(state: SwitchState, name: Name, now: Timestamps) -> SwitchFacts:
    """Return what a switch knows about a name, for a diagnosis."""
    switch, member, cache = state.switch, state.identity.member, state.switch.resolver.cache
    up, trees = switch.hello_protocol.neighbours.all_up(), list(switch.multicast.trees.of_topic(name))
    return SwitchFacts(
        name=switch.name.to_text(),
        domain=member.domain.to_text(),
        unix_s=now.unix_s,
        uptime_s=state.uptime_s(now.mono_s),
        valid_from_unix_s=float(member.not_before_unix_s),
        valid_until_unix_s=float(member.not_after_unix_s),
        rib="" if switch.rib is None else switch.rib.to_text(),
        is_rib_silent=cache.serves_stale,
        waits=state.wait_facts(now.mono_s),
        neighbours=tuple(each.name.to_text() for each in up),
        proxies=tuple(each.name.to_text() for each in up if each.role is Role.PROXY),
        reaches=_reached(state),
        attached=tuple(
            f"{each.advertisement.node.to_text()} {each.advertisement.right.value}"
            for each in switch.attached.named(name)
        ),
        locations=_locations(state, name, now.mono_s),
        is_negative=cache.is_negative(name, now.mono_s),
        readers=len(switch.state.readers.of(name)),
        branches=sum(len(tree.branches) for tree in trees),
        is_joined=any(tree.upstream is not None for tree in trees),
        drops={reason.label: count for reason, count in switch.drops().items() if count},
        pending=len(switch.resolver.pending),
    )


def _locations(state: SwitchState, name: Name, now_s: float) -> tuple[LocationFact, ...]:
    """Return the known advertisers of a name, and whether a path that the policies allow leads to their switches."""
    policy, paths = state.policy, state.switch.paths
    found = []
    for location in state.switch.resolver.cache.of(name, now_s)[:_LOCATIONS_MAX]:
        allowed = (policy.transit & location.transit) | {policy.own, location.domain}
        is_here = location.switch == state.switch.name
        found.append(
            LocationFact(
                advertiser=location.advertiser.to_text(),
                right=location.right.value,
                switch=location.switch.to_text(),
                domain=location.domain.to_text(),
                is_reachable=is_here or paths.to_switch(location.switch, location.domain, allowed) is not None,
                is_trusted=policy.trusts(location.domain),
            )
        )
    return tuple(found)


def _reached(state: SwitchState) -> tuple[str, ...]:
    """Return the switches of the own domain to which a path leads, this one included; empty: too many to list."""
    paths, own, me = state.switch.paths, state.policy.own, state.switch.name
    others = [each for each in sorted(paths.members()) if each != me]
    if len(others) >= _SWITCHES_MAX:
        return ()
    reached = [each for each in others if paths.to_switch(each, own, frozenset({own})) is not None]
    return tuple(each.to_text() for each in (me, *reached))
