"""Table I: the cost of one on-demand machine compared with two of them and with two spot machines.

Command: reads the price list of this package, prints a table, writes ``docs/experiments/table1.{md,png,json}``.
First come the paper's six applications in its two regions, then some machine types of one region.

    python scripts/experiments/table1.py                         # everything, under 5 seconds
    python scripts/experiments/table1.py --region us-west-2 --json --quick
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Final

from experiment import Report, Rows, command_line, run_experiment
from page_text import PAPERS
from plot import Bar, Panel, save_bars
from skeleton import Options

from fog.catalog.prices import aws_prices
from fog.hardware import Hardware, Offer
from fog.plan.cost import Bill, compared
from gdp.errors import LocalError

TYPES: Final = ("c5.4xlarge", "c6i.4xlarge", "m6i.4xlarge", "r5.16xlarge", "t3.xlarge", "g4dn.xlarge", "p3.2xlarge")
_WAYS: Final = ("one on-demand", "two on-demand", "two spot")
_HEAD: Final = ("application", "needs", "", *_WAYS, "two spot / one on-demand", "machines")
_TYPE_HEAD: Final = (*_WAYS, "a month: one", "two", "two spot", "two spot cost", "taken a month")
REGIONS: Final = ("us-west-1", "us-west-2")  # the paper's
APPLICATIONS: Final = {name: (needs, tuple(usd)) for name, (needs, usd) in PAPERS["applications"].items()}

# Ratio -> the prices of a row that it divides: 0: one on-demand, 1: two on-demand, 2: two spot.
_RATIOS: Final = {"one on-demand / two spot": (0, 2), "two on-demand / two spot": (1, 2)}
_RATIO_HEAD: Final = ("application", *(f"{ratio}: {whose}" for ratio in _RATIOS for whose in ("paper", "here")))


@dataclass(frozen=True, slots=True)
class Row:
    """Three costs of a machine type."""

    type_name: str
    bills: tuple[Bill, Bill, Bill]
    taken_a_month: str

    @property
    def times_cheaper(self) -> float:
        """Return the cost of one on-demand machine over that of two spot machines; below 1: they cost more."""
        return 1 / self.bills[2].of_single


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
    parser = command_line(__doc__)
    parser.add_argument("--region", default="us-east-1", help="of AWS (default: %(default)s)")
    run_experiment(parser, measure, words)


def measure(options: Options) -> Report:
    """Look up the prices; ``--quick`` takes no less time."""
    return report(options.region)


def report(region: str) -> Report:
    """Return the prices of the applications, and of the machine types of a region."""
    rows, needed = bills(region), applications()
    best, worst = (pick(rows, key=lambda row: row.times_cheaper) for pick in (max, min))
    document = {
        "region": region,
        "sources": aws_prices().sources,
        "applications": [asdict(each) for each in needed],
        "rows": [asdict(row) | {"times_cheaper": round(row.times_cheaper, 2)} for row in rows],
    }
    tables = {
        "applications": Rows(_HEAD, _application_rows(needed), words=3),
        "ratios": Rows(_RATIO_HEAD, _ratio_rows(needed)),
        "types": Rows((region, *_TYPE_HEAD), [_cells(row) for row in rows], "USD"),
    }
    figures: dict[str, object] = {
        "regions": " and ".join(REGIONS),
        "least": best.bills[2].of_single,
        "best": best.type_name,
        "most": worst.bills[2].of_single,
        "worst": worst.type_name,
        "times": best.times_cheaper,
        "sources": "; ".join(aws_prices().sources),
    }
    bars = [Bar(row.type_name, row.bills[2].of_single) for row in rows]
    panel = Panel("two spot machines", "price, of one on-demand machine", bars)
    return Report(
        "table1",
        document,
        tables,
        lambda path, title: save_bars(path, title, f"AWS {region}", [panel]),
        figures,
    )


def bills(region: str) -> list[Row]:
    """Return the rows of the types that have both prices there. Raises ``LocalError``: none has."""
    prices = aws_prices()
    offers: dict[tuple[str, bool], Offer] = {
        (offer.type_name, offer.is_spot): offer for offer in prices.offers if offer.region == region
    }
    rows = [
        Row(name, compared(offers[name, False], offers[name, True]), prices.bands[prices.band[region, name]])
        for name in TYPES
        if (name, False) in offers and (name, True) in offers
    ]
    if not rows:
        raise LocalError(
            f"no prices of {region}: expected one of {', '.join(sorted({o.region for o in prices.offers}))}"
        )
    return rows


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


def _cells(row: Row) -> tuple[str, ...]:
    hours = (f"{bill.usd_per_hour:.4f}" for bill in row.bills)
    months = (f"{bill.usd_per_month:,.2f}" for bill in row.bills)
    return (row.type_name, *hours, *months, f"{row.bills[2].of_single:.2f} ×", row.taken_a_month)


if __name__ == "__main__":
    main()
