"""Table I: the cost of one on-demand machine compared with two of them and with two spot machines.

Command: reads the price list of this package, prints a table, writes ``docs/experiments/table1.{md,png,json}``. It has
the paper's six applications in its two regions.

    python scripts/experiments/table1.py                         # under 5 seconds
    python scripts/experiments/table1.py --json --quick
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from experiment import Computed, command_line, run_experiment
from report import markdown_table, print_table
from skeleton import Options

from fog.catalog.aws import aws_prices
from fog.hardware import Hardware
from fog.offer import Offer

_WAYS: Final = ("one on-demand", "two on-demand", "two spot")
_HEAD: Final = ("application", "needs", "", *_WAYS, "two spot / one on-demand", "machines")
REGIONS: Final = ("us-west-1", "us-west-2")  # the paper's
# Application -> what a machine must have, and the paper's USD an hour: one on-demand, two on-demand, two spot.
APPLICATIONS: Final[dict[str, tuple[str, tuple[float, float, float]]]] = {
    "YOLO": ("cpu:16", (0.40, 0.80, 0.34)),
    "SAM": ("cpu:4,T4", (0.53, 1.06, 0.44)),
    "MPT Home": ("cpu:32", (1.79, 3.58, 1.69)),
    "MPT Cubicles": ("cpu:32", (1.79, 3.58, 1.69)),
    "MPT TwistyCool": ("cpu:64", (3.58, 7.16, 1.68)),
    "Pick-scan-place": ("cpu:16", (0.40, 0.80, 0.34)),
}

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


def measure(_: Options) -> Computed:
    """Look up the prices; ``--quick`` takes no less time."""
    needed = applications()

    def print_tables() -> None:
        print_table(_HEAD, _application_rows(needed), words=3)
        print_table(_RATIO_HEAD, _ratio_rows(needed))

    document = {"sources": aws_prices().sources, "applications": [asdict(each) for each in needed]}
    title = "Table I: the price of a replica"
    return Computed("table1", title, document, page(needed), print_tables, lambda path, _: _draw(path, needed))


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


def page(needed: Sequence[Application]) -> str:
    """Return the page, in Markdown."""
    parts = [
        "# Table I: the price of a replica",
        "Made by `python scripts/experiments/table1.py`.",
        "## By application",
        "USD an hour. *Here*: the cheapest machines on the list that have what the application needs; one on-demand in"
        f" the cheaper of {' and '.join(REGIONS)}, two as one in either region.",
        markdown_table(_HEAD, _application_rows(needed)),
        "The paper's prices for MPT are those of m5.8xlarge and m5.16xlarge in us-west-1 on this list (1.792 and"
        " 3.584), and that for SAM is g4dn.xlarge in us-west-2 (0.526). Here c6i in us-west-2 is cheaper for MPT. No"
        " machine of 16 cores on this list costs the paper's 0.40. Spot prices are those of other days, so they differ"
        " most.",
        "## Ratios",
        markdown_table(_RATIO_HEAD, _ratio_rows(needed)),
        "The paper's abstract says that the cost is up to 2.2 times lower. Over two on-demand machines its own prices"
        " reach that, for all applications but MPT Home and MPT Cubicles. Over one on-demand machine none does: MPT"
        " TwistyCool comes nearest, whose two spot machines cost less than those of MPT Home with half the cores.",
        "![prices](table1.png)",
        "Sources: " + "; ".join(aws_prices().sources) + ". Spot = on-demand × (1 − savings); the advisor's savings are "
        "averages in whole percent, and traffic and disks are not in the price.",
    ]
    return "\n\n".join(parts) + "\n"


def _draw(path: Path, needed: Sequence[Application]) -> None:
    from pictures import plt, save, tidy

    figure, axis = plt.subplots(figsize=(8, 4), layout="constrained")
    for at, (label, colour) in enumerate((("paper", "#99a8b2"), ("here", "#1f6f8b"))):
        prices = [(each.paper, each.usd_per_hour)[at] for each in needed]
        places = [place + (at - 0.5) * 0.4 for place in range(len(needed))]
        axis.bar(places, [usd[2] / usd[0] for usd in prices], 0.36, color=colour, label=label)
    axis.axhline(1, color="#222222", lw=0.7)
    axis.set_xticks(range(len(needed)), [each.name for each in needed], fontsize=8)
    axis.set_ylabel("two spot / one on-demand")
    axis.set_ylim(0, 1.3)
    tidy(axis, ncols=2, loc="upper left")
    save(figure, path)


if __name__ == "__main__":
    main()
