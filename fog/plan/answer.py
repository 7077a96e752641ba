"""Result of ``fog plan``: pool, choices and price, with all assumptions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fog.cluster import MachineRequest
from fog.hardware import Hardware, Offer
from fog.plan.choice import BY_BOTH, Choice, Weights, choose
from fog.plan.duration import duration_text
from fog.plan.evidence import Measured
from fog.plan.failure import chance_down, joint, joint_over_regions
from fog.plan.mix import Kind
from fog.plan.pool import ON_DEMAND_DOWN, PAPER_RECOVERY_S, PAPER_UPTIME_S, Pool, Standing, pool_for


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """Input of a plan.

    Args:
        target: largest share of time without any replica.
        uptime_s, recovery_s: None: the paper's worked example.
        kinds: kinds of machines that may be added: ``spot``, ``on-demand``.
        spot, on_demand: number of each that run already.
        latency_ms: of regions, as measured from the robot.
    """

    target: float
    hardware: Hardware
    uptime_s: float | None = None
    recovery_s: float | None = None
    kinds: tuple[str, ...] = ("spot",)
    spot: int = 0
    on_demand: int = 0
    latency_ms: Mapping[str, float] | None = None
    weights: Weights = BY_BOTH


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """Computed plan.

    Args:
        replicas: total, including those that run already.
        p_vm: share of time for which one of the machines to be added is down; in a mixed pool: of a spot machine.
        p_system: share of time for which all replicas are down, placed as chosen: different regions are independent,
            spot machines of one region are not.
        factor: ratio of joint failures of a pair in one region to independent failures.
        independent: result of the formula alone.
        as_recorded: the same with the uptime of the recorded traces.
    """

    replicas: int
    p_vm: float
    p_system: float
    uptime_s: float
    recovery_s: float
    factor: float
    choices: tuple[Choice, ...]
    independent: Pool
    as_recorded: Pool
    assumptions: tuple[str, ...]

    @property
    def usd_per_hour(self) -> float:
        """Return the price of the machines to be added."""
        return sum(choice.offer.usd_per_hour for choice in self.choices)


def answer(question: Question, offers: Sequence[Offer], seen: Measured) -> Answer:
    """Compute a plan. Raises ``LocalError``: an input is out of bounds, or no offer has enough hardware."""
    uptime_s = question.uptime_s or PAPER_UPTIME_S
    recovery_s = question.recovery_s or PAPER_RECOVERY_S
    factor = seen.factors[1]
    down = chance_down(uptime_s, recovery_s)
    pool = _pool(question, offers, down, factor)
    choices, p_system = _placed(question, offers, pool, down, factor)
    has_on_demand = "on-demand" in question.kinds or question.on_demand > 0
    kinds = ("spot", "on-demand") if has_on_demand else ("spot",)
    assumed = assumptions(kinds, seen, question.uptime_s, question.recovery_s)
    if question.spot:
        assumed.append("spot machines that run already are in regions of their own")
    if p_system > question.target * (1 + 1e-9):
        assumed.append("the target is out of reach in so few regions, as far as those traces tell")
    return Answer(
        replicas=question.spot + question.on_demand + len(choices),
        p_vm=down if "spot" in question.kinds else ON_DEMAND_DOWN,
        p_system=p_system,
        uptime_s=uptime_s,
        recovery_s=recovery_s,
        factor=factor,
        choices=tuple(choices),
        independent=pool,
        as_recorded=_pool(question, offers, chance_down(seen.uptime_s, recovery_s), factor),
        assumptions=tuple(assumed),
    )


def _placed(
    question: Question, offers: Sequence[Offer], pool: Pool, down: float, factor: float
) -> tuple[list[Choice], float]:
    """Return the choices for a pool and its joint failure, with more spot machines if it must share regions."""
    more = dict(zip(question.kinds, pool.mix.more, strict=True))
    steady = joint([down] * question.spot + [ON_DEMAND_DOWN] * (question.on_demand + more.get("on-demand", 0)))

    def place(spots: int) -> tuple[list[Choice], float]:
        wanted = [MachineRequest(question.hardware, is_spot=True)] * spots
        wanted += [MachineRequest(question.hardware)] * more.get("on-demand", 0)
        choices = choose(offers, wanted, question.latency_ms, question.weights)
        regions: dict[str, list[float]] = {}
        for choice in choices[:spots]:
            regions.setdefault(choice.offer.region, []).append(down)
        return choices, steady * joint_over_regions(regions, factor)

    spots = more.get("spot", 0)
    first = best = place(spots)
    while best[1] > question.target * (1 + 1e-9) and "spot" in question.kinds:
        spots += 1
        one_more = place(spots)
        if one_more[1] >= best[1]:
            return first  # another machine in the same regions changes nothing
        best = one_more
    return best


def _pool(question: Question, offers: Sequence[Offer], down: float, factor: float) -> Pool:
    spot, on_demand = (
        Kind(name, chance, _cheapest(question, offers, spot=name == "spot") if name in question.kinds else 0.0)
        for name, chance in (("spot", down), ("on-demand", ON_DEMAND_DOWN))
    )
    standing = Standing((down,) * question.spot, (ON_DEMAND_DOWN,) * question.on_demand)
    if question.kinds == ("on-demand",):
        return pool_for(question.target, on_demand, None, 1.0, standing)
    return pool_for(question.target, spot, on_demand if "on-demand" in question.kinds else None, factor, standing)


def _cheapest(question: Question, offers: Sequence[Offer], *, spot: bool) -> float:
    wanted = MachineRequest(question.hardware, is_spot=spot)
    return choose(offers, [wanted], question.latency_ms, question.weights)[0].offer.usd_per_hour


def assumptions(
    kinds: Sequence[str], seen: Measured, uptime_s: float | None = None, recovery_s: float | None = None
) -> list[str]:
    """Return the assumptions of a plan with machines of these kinds (``spot``, ``on-demand``).

    Args:
        uptime_s, recovery_s: of a spot machine; None: the paper's worked example.
    """
    paper = "the worked example of FogROS2-FT, which is not a measurement"
    low, high = seen.factors
    said = []
    if "spot" in kinds:
        said += [
            f"a spot machine serves for {duration_text(uptime_s or PAPER_UPTIME_S)} on average"
            + ("" if uptime_s else f": {paper}"),
            f"{duration_text(recovery_s or PAPER_RECOVERY_S)} after it is taken another one serves"
            + ("" if recovery_s else f": {paper}"),
            "machines in different regions fail independently: there are no data that say so, or otherwise",
            f"machines in one region fail together {low:g} to {high:g} times as often as independent ones; counted with"
            f" {high:g}; {seen.source}",
            f"in those traces a spot machine stayed for {duration_text(seen.uptime_s)} on average",
        ]
    if "on-demand" in kinds:
        said.append(
            f"an on-demand machine is down {ON_DEMAND_DOWN:.1%} of the time: all that AWS's service level agreement "
            "promises for one; on-demand machines fail independently"
        )
    return said
