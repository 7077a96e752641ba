"""Election of the machine that is the gateway of its group: one of the machines next to a replica gateway.

Sans-I/O. Source: FogROS2-FT, Figure 4, right; the election is made by the supervisor, not among the machines as in VRRP
(RFC 9568), because only the provider can move the uplink.

A gateway keeps its role while it works. Each result follows from the records alone, so a restarted supervisor elects
the same machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fog.supervisor.core.reconcile import Timeouts
from fog.supervisor.core.record import Record


@dataclass(frozen=True, slots=True)
class Election:
    """Change of the role; ``old``: previous gateway, if the machine still exists."""

    new: Record
    old: Record | None
    reason: str


def elect(group: Sequence[Record], label: str, now_s: float, patience: Timeouts) -> Election | None:
    """Return the due change of a group's gateway; None: no change, or no machine can be the gateway.

    Criteria in this order: up, reachable, not the gateway before, not a spot machine, older.

    Args:
        group: machines of this gateway, of all clusters. Machines that are gone only explain a change.
    """
    there = [each for each in group if not each.is_gone and each.id]
    old = next((each for each in there if each.gateway == label), None)
    fit = [each for each in there if each is not old and not each.is_outgoing]
    if not fit:
        return None
    best = min(fit, key=_rank)
    if old is None:
        lost = max((each for each in group if each.is_gone and each.gateway == label), key=_last_s, default=None)
        return Election(best, None, "the first machine" if lost is None else f"{lost.name} is gone: {lost.reason}")
    if old.up_unix_s is None:
        is_cut_off = best.up_unix_s is not None and not best.is_serving  # otherwise its switch may already forward
        is_late = now_s - _last_s(old) >= (patience.gateway_s if is_cut_off else patience.partition_timeout_s)
        return Election(best, old, f"{old.name} does not come up") if is_late else None
    if best.up_unix_s is None:
        return None  # it would not forward yet
    if old.is_outgoing:
        return Election(best, old, f"{old.name} leaves: {old.reason}")
    if _is_suspect(old, there, now_s, patience) and _last_s(best) < (old.unreachable_unix_s or 0.0):
        return Election(best, old, f"behind {old.name} no replica is heard")
    return None


def excused_names(group: Sequence[Record], label: str, now_s: float, patience: Timeouts) -> frozenset[str]:
    """Return which machines of a group are kept although their replicas may be unreachable.

    While a gateway is new, silence behind it says nothing about any machine. What fell silent before the paths were
    formed again may need longer, as after a partition. So may a gateway behind which a replica is heard: it forwards,
    and its release would cut off the others.
    """
    settled_s = max((_last_s(each) for each in group if each.gateway == label), default=0.0) + patience.gateway_s
    if now_s < settled_s:
        return frozenset(each.name for each in group)
    forwards = any(each.is_serving and each.gateway != label for each in group)
    return frozenset(
        each.name
        for each in group
        if each.unreachable_unix_s is not None
        and now_s - each.unreachable_unix_s < patience.partition_timeout_s
        and (each.unreachable_unix_s < settled_s or (forwards and each.gateway == label))
    )


def _is_suspect(gateway: Record, there: Sequence[Record], now_s: float, patience: Timeouts) -> bool:
    """Return whether a running gateway seems not to forward: no replica of the group is reachable."""
    if gateway.unreachable_unix_s is None or any(each.is_serving for each in there):
        return False
    since_s = max(gateway.unreachable_unix_s + patience.unreachable_timeout_s, _last_s(gateway) + patience.gateway_s)
    return now_s >= since_s


def _rank(record: Record) -> tuple[bool, bool, float, bool, float, str]:
    is_spot = record.spec.offer.is_spot
    return record.up_unix_s is None, not record.is_serving, _last_s(record), is_spot, record.asked_unix_s, record.name


def _last_s(record: Record) -> float:
    return record.gateway_unix_s or 0.0
