"""Schedule of faults: drawn from a seed, overlapping, without parting what must stay connected.

Sans-I/O. Faults of the kinds in ``STRUCTURAL`` remove a switch or a link. One is drawn only if the rest stays whole
with everything that is broken at that moment, by the oracle. A partition is the exception: it parts a domain on
purpose, while no other fault is active.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from typing import Final

from faults.plan import VICTIM, Oracle, Plan
from lab.faults import STORE, Fault, FaultKind, broken_by

KILLS: Final = {FaultKind.KILL_SWITCH: "switch", FaultKind.KILL_RIB: "rib", FaultKind.KILL_MEMBER: "member"}
STRUCTURAL: Final = frozenset({FaultKind.CUT, FaultKind.SILENT, FaultKind.KILL_SWITCH})
_WEIGHTS: Final = {
    FaultKind.CUT: 4, FaultKind.SILENT: 3, FaultKind.LOSS: 3, FaultKind.DOUBLED: 2, FaultKind.REORDERED: 2,
    FaultKind.KILL_SWITCH: 3, FaultKind.KILL_RIB: 3, FaultKind.KILL_MEMBER: 2, FaultKind.FREEZE: 3,
    FaultKind.CLOCK: 2, FaultKind.PARTITION: 1, FaultKind.ROAM: 4, FaultKind.DISK_FULL: 2,
    FaultKind.KILL_PRIMARY: 2, FaultKind.KILL_REPLICA: 1, FaultKind.FREEZE_PRIMARY: 2,
}  # fmt: skip
DISK: Final = "the disk"
_OF_STORE: Final = frozenset({FaultKind.KILL_PRIMARY, FaultKind.KILL_REPLICA, FaultKind.FREEZE_PRIMARY})
_STORE_LEAST_S: Final = 3.0  # a replica takes over within two seconds: a shorter fault would end in the middle of that
_SERVERS: Final = 3  # number of servers of a role
_AT_ONCE: Final = 3
_CLOCK_STEP_S: Final = 300.0
_PACE_S: Final = 2.0  # mean time between the starts of two faults
_FIRST_S: Final = 1.0
_TRIES: Final = 40


def make_schedule(
    plan: Plan,
    seed: int,
    duration_s: float,
    *,
    kinds: Sequence[FaultKind] | None = None,
    has_store: bool = False,
) -> list[Fault]:
    """Return the faults of a run, in the order of their starts.

    ``duration_s``: when the last fault has ended. ``kinds``: what may happen; None: everything. ``has_store``: RIBs
    share a store of several servers, which may fail.
    """
    drawn = set(kinds or FaultKind) - (frozenset() if has_store else _OF_STORE)
    return list(_draw(plan, random.Random(f"schedule {seed}"), duration_s, drawn))


def _draw(plan: Plan, chance: random.Random, duration_s: float, kinds: set[FaultKind]) -> Iterator[Fault]:
    oracle, under_way, at = Oracle(plan), list[Fault](), {mover: homes[0] for mover, homes in plan.homes.items()}
    weights = {kind: weight for kind, weight in _WEIGHTS.items() if kind in kinds}
    revoke_s = duration_s * 0.6 if FaultKind.REVOKE in kinds and VICTIM in plan.members else None
    now_s = _FIRST_S
    while weights:
        now_s += min(chance.expovariate(1 / _PACE_S), 4 * _PACE_S)
        if now_s >= duration_s:
            break
        under_way = [fault for fault in under_way if fault.end_s > now_s]
        if revoke_s is not None and now_s >= revoke_s:
            revoke_s = None
            yield Fault(FaultKind.REVOKE, (VICTIM,), now_s, now_s)
            continue
        if len(under_way) >= _AT_ONCE:
            continue
        for _ in range(_TRIES):
            kind = chance.choices(list(weights), list(weights.values()))[0]
            fault = _one(kind, plan, oracle, chance, now_s, duration_s, at)
            if fault is not None and _is_fit(fault, under_way, oracle, at):
                under_way.append(fault)
                if kind is FaultKind.ROAM:
                    at[fault.targets[0]] = fault.targets[1]
                yield fault
                break


def _one(
    kind: FaultKind, plan: Plan, oracle: Oracle, chance: random.Random, now_s: float, duration_s: float,
    at: dict[str, str],
) -> Fault | None:  # fmt: skip
    end_s = min(now_s + chance.uniform(0.5, 8.0), duration_s)
    if kind in (FaultKind.CUT, FaultKind.SILENT, FaultKind.LOSS, FaultKind.DOUBLED, FaultKind.REORDERED):
        return Fault(kind, tuple(sorted(chance.choice(oracle.links))), now_s, end_s)
    nodes = {"switch": plan.switches, "rib": plan.ribs, "member": [each for each in plan.members if each != VICTIM]}
    if kind in KILLS or kind in (FaultKind.FREEZE, FaultKind.CLOCK):
        role = KILLS.get(kind) or chance.choice(list(nodes))
        who = f"{role} {chance.choice(nodes[role])}"
        if kind in KILLS:
            return Fault(kind, (who,), now_s, end_s)
        if kind is FaultKind.FREEZE:
            return Fault(kind, (who,), now_s, min(now_s + chance.uniform(0.3, 3.0), duration_s))
        return Fault(kind, (who,), now_s, end_s, chance.choice((-_CLOCK_STEP_S, _CLOCK_STEP_S)))
    if kind is FaultKind.PARTITION:
        domain = chance.choice(plan.topology.domains[1:])
        own = set(domain.switches)
        out = [link for link in oracle.links if len(link & own) == 1]
        return Fault(kind, (domain.label, *sorted("-".join(sorted(link)) for link in out)), now_s, end_s)
    if kind is FaultKind.DISK_FULL:
        killed = [f"rib {node}" for node in chance.sample(plan.ribs, chance.randrange(2))]
        return Fault(kind, (DISK, *killed), now_s, end_s)
    if kind in _OF_STORE:
        end_s = now_s + chance.uniform(_STORE_LEAST_S, 8.0)
        number = chance.randrange(_SERVERS)
        return Fault(kind, (STORE,), now_s, end_s, number) if end_s <= duration_s else None
    mover = chance.choice(sorted(plan.homes))
    there = chance.choice([home for home in plan.homes[mover] if home != at[mover]])
    return Fault(FaultKind.ROAM, (mover, there), now_s, now_s)


def _is_fit(fault: Fault, under_way: Sequence[Fault], oracle: Oracle, at: dict[str, str]) -> bool:
    """Return whether a fault may be added to those in progress."""
    busy = {target for each in under_way for target in _touched(each)}
    if busy & _touched(fault):
        return False
    is_frozen_switch = fault.kind is FaultKind.FREEZE and fault.targets[0].startswith("switch")
    if fault.kind is FaultKind.PARTITION:
        return not any(each.kind in STRUCTURAL or each.kind is FaultKind.FREEZE for each in under_way)
    if fault.kind in STRUCTURAL or is_frozen_switch:
        if any(each.kind is FaultKind.PARTITION for each in under_way):
            return False
        return oracle.is_whole(broken_by([*under_way, fault], at))
    if fault.kind is FaultKind.ROAM:
        return fault.targets[1] not in broken_by(under_way, at).switches
    return True


def _touched(fault: Fault) -> set[str]:
    """Return what no other fault may touch meanwhile: a process by name, a link by its ends."""
    if fault.kind is FaultKind.PARTITION:
        return set(fault.targets[1:])
    if len(fault.targets) == 2 and fault.kind not in (FaultKind.ROAM, FaultKind.DISK_FULL):
        return {"-".join(fault.targets)}
    if fault.kind is FaultKind.ROAM:
        return {f"member {fault.targets[0]}"}
    return set(fault.targets)
