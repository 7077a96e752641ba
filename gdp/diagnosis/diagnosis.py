"""Diagnosis: the rules of all causes, and the first cause that holds.

Sans-I/O. The causes are tried in the order of ``Cause``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from gdp.diagnosis import name_rules, network_rules, right_rules, stream_rules
from gdp.diagnosis.answer import Answer, Cause
from gdp.diagnosis.facts import Facts
from gdp.diagnosis.view import Rule, View
from gdp.intervals import REPORT_S

_RULES: Final = network_rules.RULES | name_rules.RULES | right_rules.RULES | stream_rules.RULES
RULES: Final[Mapping[Cause, Rule]] = {cause: _RULES[cause] for cause in Cause if cause in _RULES}
_MAY_SETTLE: Final = frozenset(
    {
        Cause.LINK_SILENT,
        Cause.ETHERTYPE_FILTERED,
        Cause.NO_ROUTE,
        Cause.RIB_DOWN,
        Cause.NO_READER_HERE,
        Cause.NO_PUBLISHER,
        Cause.NO_SERVER,
        Cause.NO_ADVERTISER,
        Cause.REPLICAS_SILENT,
        Cause.MTU_HOLE,
        Cause.NOT_EXPOSED,
        Cause.UNKNOWN,
        Cause.PATH_LOSES,
        Cause.UNTRUSTED_DOMAIN,
        Cause.NAT_CLOSED,
        Cause.TUNNEL_DOWN,
        Cause.RIB_SILENT,
    }
)


def diagnose(facts: Facts) -> Answer:
    """Return the first cause of the table that holds, or that the facts do not suffice."""
    view = View(facts)
    unknown = tuple(f"{each.role} {each.where}: {each.why}" for each in facts.unreachable)
    for cause, rule in RULES.items():
        found = next(rule(view), None)
        if found is not None:
            if cause in _MAY_SETTLE and _is_fresh(view):
                return _starting(view, unknown)
            return Answer(cause, *found, unknown=unknown)
    if _is_fresh(view):
        return _starting(view, unknown)
    return Answer(Cause.UNKNOWN, _cannot_tell(view), f"gdp trace {facts.asked}", unknown)


def _is_fresh(view: View) -> bool:
    ages_s = [each.uptime_s for each in view.facts.proxies]
    ages_s += [each.flow.age_s for each in view.ends if each.flow.is_carried]
    return any(age_s < REPORT_S for age_s in ages_s)


def _starting(view: View, unknown: tuple[str, ...]) -> Answer:
    text = f"It began less than {REPORT_S:g} s ago and is still finding its way; ask again then."
    return Answer(Cause.STARTING, text, f"gdp explain {view.facts.asked}", unknown)


def _cannot_tell(view: View) -> str:
    lacking = "no far proxy" if not view.far_proxies else "no RIB" if not view.facts.ribs else "no switch"
    if view.far_proxies and view.facts.ribs and view.facts.switches:
        return "Everything that could be asked is whole, so the cause is not known."
    return f"Nothing is wrong with what could be asked, but {lacking} could be."
