"""Table I: the cost of one on-demand machine compared with two of them and with two spot machines.

Command: reads the price list of this package, prints a table of the paper's six applications in its two regions, and
writes ``docs/experiments/table1.{md,png,json}``. It takes under 5 seconds.

    python scripts/experiments/table1.py
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Final

from experiment import PAPERS, Report, Rows, command_line, run_experiment
from plot import Bar, Panel, save_bars
from skeleton import Options

from fog.catalog.prices import aws_prices
from fog.hardware import Hardware, Offer

_WAYS: Final = ("one on-demand", "two on-demand", "two spot")
_HEAD: Final = ("application", "needs", "", *_WAYS, "two spot / one on-demand", "machines")
REGIONS: Final = ("us-west-1", "us-west-2")  # the paper's
APPLICATIONS: Final = {name: (needs, tuple(usd)) for name, (needs, usd) in PAPERS["applications"].items()}

# Ratio -> the prices of a row that it divides: 0: one on-demand, 1: two on-demand, 2: two spot.
_RATIOS: Final = {"one on-demand / two spot": (0, 2), "two on-demand / two spot": (1, 2)}
_RATIO_HEAD: Final = ("application", *(f"{ratio}: {whose}" for ratio in _RATIOS for whose in ("paper", "here")))


@dataclass(frozen=True, slots=True)
class Application:
    """Three costs of an application, on the cheapest machines that meet its needs.

    ``needs``: as in ``fog.hardware``. ``on_demand``: machine and region, one a region, the cheaper one first. ``spot``:
    the same. ``usd_per_hour``: one on-demand, two on-demand, two spot. ``paper``: the same three.
    """

    name: str
    needs: str
    on_demand: tuple[str, str]
    spot: tuple[str, str]
    usd_per_hour: tuple[float, float, float]
    paper: tuple[float, float, float]


def main(words: Sequence[str] | None = None) -> None:
    """Compare the cost of one on-demand machine, two on-demand machines and two spot machines."""
    run_experiment(command_line(__doc__), measure, words)


def measure(_: Options) -> Report:
    """Look up the prices; ``--quick`` takes no less time."""
    needed = applications()
    unit = "price of two spot machines, of one on-demand machine"
    panels = [
        Panel("paper", unit, [Bar(each.name, each.paper[2] / each.paper[0], ours=False) for each in needed]),
        Panel("here", unit, [Bar(each.name, each.usd_per_hour[2] / each.usd_per_hour[0]) for each in needed]),
    ]
    return Report(
        "table1",
        {"sources": aws_prices().sources, "applications": [asdict(each) for each in needed]},
        {
            "applications": Rows(_HEAD, _application_rows(needed), words=3),
            "ratios": Rows(_RATIO_HEAD, _ratio_rows(needed)),
        },
        lambda path, title: save_bars(path, title, "AWS", panels),
        {"regions": " and ".join(REGIONS), "sources": "; ".join(aws_prices().sources)},
    )


def applications() -> list[Application]:
    """Return the paper's applications, each with a replica in either region of the paper."""
    found = []
    for name, (needs, paper) in APPLICATIONS.items():
        wanted = Hardware.from_text(needs)
        on_demand, spot = (
            sorted((_cheapest(region, wanted, is_spot=kind) for region in REGIONS), key=lambda each: each.usd_per_hour)
            for kind in (False, True)
        )
        one, two, two_spot = on_demand[0].usd_per_hour, _sum(on_demand), _sum(spot)
        found.append(Application(name, needs, _where(on_demand), _where(spot), (one, two, two_spot), paper))
    return found


def _cheapest(region: str, wanted: Hardware, *, is_spot: bool) -> Offer:
    offers = (each for each in aws_prices().offers if each.region == region and each.is_spot == is_spot)
    return min((each for each in offers if wanted.fits(each.hardware)), key=lambda each: each.usd_per_hour)


def _sum(offers: Sequence[Offer]) -> float:
    return round(sum(each.usd_per_hour for each in offers), 4)


def _where(offers: Sequence[Offer]) -> tuple[str, str]:
    one, other = (f"{each.type_name} {each.region}" for each in offers)
    return one, other


def _application_rows(needed: Sequence[Application]) -> list[tuple[str, ...]]:
    rows = []
    for each in needed:
        where = f"on-demand {', '.join(each.on_demand)}; spot {', '.join(each.spot)}"
        for labels, usd, machines in (
            ((each.name, each.needs, "paper"), each.paper, ""),
            (("", "", "here"), each.usd_per_hour, where),
        ):
            rows.append((*labels, *(f"{price:.2f}" for price in usd), f"{usd[2] / usd[0]:.2f}", machines))
    return rows


def _ratio_rows(needed: Sequence[Application]) -> list[tuple[str, ...]]:
    """Return the ratios of each application's prices, the paper's and ours in turn."""
    priced = ((each.name, (each.paper, each.usd_per_hour)) for each in needed)
    return [
        (name, *(f"{usd[a]:.2f}/{usd[b]:.2f} = {usd[a] / usd[b]:.2f}" for a, b in _RATIOS.values() for usd in both))
        for name, both in priced
    ]


if __name__ == "__main__":
    main()
