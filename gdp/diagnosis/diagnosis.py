"""Diagnosis: the ordered table of causes, and the first that holds.

Sans-I/O. The order is that of a path: what stops everything comes first. "It arrives" precedes every fault but a
missing proxy, so a name that flows never raises an alarm.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from gdp.diagnosis import name_rules, network_rules, right_rules, stream_rules
from gdp.diagnosis.answer import Answer, Cause
from gdp.diagnosis.facts import Facts
from gdp.diagnosis.network_rules import Found
from gdp.diagnosis.view import View

__all__ = ["RULES", "SETTLE_S", "diagnose"]

SETTLE_S: Final = 5.0  # a node or flow that is younger may still be finding its way

RULES: Final[tuple[tuple[Cause, Callable[[View], Found]], ...]] = (
    (Cause.NO_PROXY_HERE, network_rules.no_proxy_here),
    (Cause.ARRIVES, stream_rules.arrives),
    (Cause.CLOCK, network_rules.clock),
    (Cause.IDENTITY_IN_USE, network_rules.identity_in_use),
    (Cause.MEMBERSHIP_REVOKED, network_rules.membership_revoked),
    (Cause.MEMBERSHIP_EXPIRED, network_rules.membership_expired),
    (Cause.INTERFACE_DOWN, network_rules.interface_down),
    (Cause.NAME_UNKNOWN, name_rules.name_unknown),
    (Cause.NOT_IMPORTED, name_rules.not_imported),
    (Cause.SWITCH_DOWN, network_rules.switch_down),
    (Cause.UNTRUSTED_DOMAIN, network_rules.untrusted_domain),
    (Cause.NAT_CLOSED, network_rules.nat_closed),
    (Cause.TUNNEL_DOWN, network_rules.tunnel_down),
    (Cause.ETHERTYPE_FILTERED, network_rules.ethertype_filtered),
    (Cause.RIB_DOWN, network_rules.rib_down),
    (Cause.LINK_SILENT, network_rules.link_silent),
    (Cause.NO_ROUTE, network_rules.no_route),
    (Cause.FAR_PROXY_DOWN, network_rules.far_proxy_down),
    (Cause.TYPE_SUPPORT_MISSING, name_rules.type_support_missing),
    (Cause.LOCAL_TYPE_DIFFERS, name_rules.local_type_differs),
    (Cause.GRAPH_AWAY, name_rules.graph_away),
    (Cause.RIVAL_PROXY, name_rules.rival_proxy),
    (Cause.TYPE_DIFFERS, name_rules.type_differs),
    (Cause.OWNER_DIFFERS, name_rules.owner_differs),
    (Cause.METADATA_DIFFERS, name_rules.metadata_differs),
    (Cause.DELEGATION_EXPIRED, right_rules.delegation_expired),
    (Cause.DELEGATION_REVOKED, right_rules.delegation_revoked),
    (Cause.DELEGATION_MISSING, right_rules.delegation_missing),
    (Cause.RIGHT_MISSING, right_rules.right_missing),
    (Cause.QUOTA, right_rules.quota),
    (Cause.ADVERTISEMENT_REFUSED, right_rules.advertisement_refused),
    (Cause.SHARED_MEMORY_ONLY, name_rules.shared_memory_only),
    (Cause.ROS_DOMAIN_DIFFERS, name_rules.ros_domain_differs),
    (Cause.NO_READER_HERE, name_rules.no_reader_here),
    (Cause.NO_PUBLISHER, name_rules.no_publisher),
    (Cause.NO_SERVER, name_rules.no_server),
    (Cause.NOT_EXPOSED, name_rules.not_exposed),
    (Cause.RIB_SILENT, network_rules.rib_silent),
    (Cause.NO_ADVERTISER, name_rules.no_advertiser),
    (Cause.REPLICAS_SILENT, name_rules.replicas_silent),
    (Cause.KEY_EPOCH, stream_rules.key_epoch),
    (Cause.KEYS_DIFFER, stream_rules.keys_differ),
    (Cause.QOS_IMPOSSIBLE, stream_rules.qos_impossible),
    (Cause.TOO_LARGE, stream_rules.too_large),
    (Cause.RATE_LIMIT, stream_rules.rate_limit),
    (Cause.BIT_RATE_LIMIT, stream_rules.bit_rate_limit),
    (Cause.DEADLINE, stream_rules.deadline),
    (Cause.QOS_RELIABILITY, stream_rules.qos_reliability),
    (Cause.QOS_DURABILITY, stream_rules.qos_durability),
    (Cause.PENDING_FULL, stream_rules.pending_full),
    (Cause.MEMORY_FULL, stream_rules.memory_full),
    (Cause.TOO_FAST, stream_rules.too_fast),
    (Cause.MTU_HOLE, stream_rules.mtu_hole),
    (Cause.MALFORMED, stream_rules.malformed),
    (Cause.CALL_FAILED, stream_rules.call_failed),
    (Cause.PATH_LOSES, stream_rules.path_loses),
    (Cause.PUBLISHER_SILENT, stream_rules.publisher_silent),
    (Cause.IDLE, stream_rules.idle),
)
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
    for cause, rule in RULES:
        found = rule(view)
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
    return any(age_s < SETTLE_S for age_s in ages_s)


def _starting(view: View, unknown: tuple[str, ...]) -> Answer:
    text = f"It began less than {SETTLE_S:g} s ago and is still finding its way; ask again then."
    return Answer(Cause.STARTING, text, f"gdp explain {view.facts.asked}", unknown)


def _cannot_tell(view: View) -> str:
    lacking = "no far proxy" if not view.far_proxies else "no RIB" if not view.facts.ribs else "no switch"
    if view.far_proxies and view.facts.ribs and view.facts.switches:
        return "Everything that could be asked is whole, so the cause is not known."
    return f"Nothing is wrong with what could be asked, but {lacking} could be."
