"""``fog plan``: number, offers and price of machines for a target. ``fog prices``: prices of machines."""

from __future__ import annotations

import json
import time
from typing import Annotated

import typer
from rich.table import Column, Table

from fog.catalog.measured import measured
from fog.catalog.prices import aws_prices, price_list, regions_of
from fog.cli.options import SiteFile, State
from fog.cli.views import latency_lines, ms_text
from fog.hardware import HOURS_A_MONTH, Hardware, Offer
from fog.plan.answer import Answer, Question, answer
from fog.plan.choice import BY_BOTH, Weights
from fog.plan.duration import duration_text, seconds_from_text
from fog.site import peek_site
from gdp.cli.console import Columns, console, folding
from gdp.cli.node import failing_clearly
from gdp.errors import LocalError
from gdp.intervals import DAY_S
from gdp.terminal import echo

_MOST_ROWS = 15

Target = Annotated[float, typer.Option(help="largest share of time without any replica, such as 0.0005")]
Uptime = Annotated[
    str | None, typer.Option(metavar="SPAN", help="how long a spot machine serves on average, such as 15h")
]
Recovery = Annotated[
    str | None, typer.Option(metavar="SPAN", help="from its being taken until another one serves, such as 20min")
]
HardwareText = Annotated[str, typer.Option("--hardware", help="what each machine must have, such as cpu:16 or T4")]
Regions = Annotated[list[str], typer.Option("--region", metavar="REGION", help="only these; may be repeated")]
Provider = Annotated[str, typer.Option(help="whose prices: aws or local")]
Spot = Annotated[bool, typer.Option("--spot/--on-demand", help="which machines may be added")]
Mixed = Annotated[bool, typer.Option("--mixed", help="both may be added, whatever is cheaper")]
Have = Annotated[list[str], typer.Option("--have", metavar="KIND[:N]", help="run already: spot:1, on-demand:2")]
Latency = Annotated[
    list[str], typer.Option("--latency", metavar="REGION=MS", help="measured from the robot; may be repeated")
]
PerMs = Annotated[float, typer.Option("--usd-per-ms", min=0.0, help="what a millisecond less may cost in an hour")]
AsJson = Annotated[bool, typer.Option("--json", help="print one JSON object")]
All = Annotated[bool, typer.Option("--all", help="every line, not only the cheapest")]


def plan(
    target: Target,
    uptime: Uptime = None,
    recovery: Recovery = None,
    hardware: HardwareText = "cpu:4",
    region: Regions = [],  # noqa: B006
    provider: Provider = "aws",
    spot: Spot = True,
    mixed: Mixed = False,
    have: Have = [],  # noqa: B006
    latency: Latency = [],  # noqa: B006
    usd_per_ms: PerMs = BY_BOTH.usd_per_hour_per_ms,
    columns: Columns = None,
    as_json: AsJson = False,
) -> None:
    """Say how many replicas the wanted availability takes, where, at what price, and what that assumes.

    Nothing is started.

    \b
    Example:
      fog plan --target 0.0005 --uptime 15h --recovery 20min --hardware cpu:16
    """
    del columns  # the option's callback sets it
    with failing_clearly():
        wanted = Hardware.from_text(hardware)
        standing = _standing(have)
        question = Question(
            target=target,
            hardware=wanted,
            uptime_s=None if uptime is None else _positive(uptime),
            recovery_s=None if recovery is None else _positive(recovery),
            kinds=("spot", "on-demand") if mixed else ("spot",) if spot else ("on-demand",),
            spot=standing["spot"],
            on_demand=standing["on-demand"],
            latency_ms=_latencies(latency),
            weights=Weights(usd_per_ms),
        )
        result = answer(question, _offers(provider, region), measured())
        if as_json:
            echo(json.dumps(_document(question, result), ensure_ascii=False))
        else:
            _show(question, result)


def cost_table(
    hardware: HardwareText = "cpu:4",
    region: Regions = [],  # noqa: B006
    provider: Provider = "aws",
    everything: All = False,
    columns: Columns = None,
    site: SiteFile = None,
    state: State = None,
    as_json: AsJson = False,
) -> None:
    """Say what machines with enough hardware cost, on demand and as spot machines, by the hour and the month.

    With fog.yaml also how far each region is, as stated or measured there.

    \b
    Example:
      fog prices --hardware T4 --region us-east-1
    """
    del columns  # the option's callback sets it
    with failing_clearly():
        wanted = Hardware.from_text(hardware)
        on_demand = {(o.region, o.type_name): o for o in price_list(provider, wanted, spot=False, regions=region)}
        spots = {(o.region, o.type_name): o for o in price_list(provider, wanted, spot=True, regions=region)}
        if not on_demand:
            raise LocalError(f"{provider} has no price of a machine with {wanted.to_text()}")
        with peek_site(site, state) as here:
            regions = list(dict.fromkeys(where for where, _ in on_demand))
            here.latencies.refresh(regions, time.time())
            latencies = here.latencies.lookup(regions, time.time())
        aws = aws_prices()
        rows: list[dict[str, object]] = []
        for (where, name), offer in sorted(
            on_demand.items(), key=lambda item: (spots.get(item[0], item[1]).usd_per_hour, item[0])
        ):
            spot = spots.get((where, name))
            band = aws.band.get((where, name)) if provider == "aws" else None
            rows.append(
                {
                    "region": where,
                    "type": name,
                    "hardware": offer.hardware.to_text(),
                    "on_demand_usd_per_hour": offer.usd_per_hour,
                    "spot_usd_per_hour": spot and spot.usd_per_hour,
                    "taken_a_month": None if band is None else aws.bands[band],
                    "latency_ms": latencies[where].ms,
                    "latency_source": latencies[where].source,
                }
            )
        if as_json:
            echo(json.dumps({"provider": provider, "sources": list(_sources(provider)), "offers": rows}))
            return
        shown = rows if everything else rows[:_MOST_ROWS]
        prices = _right("ms", "on demand /h", "spot /h", "spot /month")
        table = folding(Table("region", "type", "hardware", *prices, "taken a month"))
        for row in shown:
            usd = spots.get((str(row["region"]), str(row["type"])))
            table.add_row(
                str(row["region"]),
                str(row["type"]),
                str(row["hardware"]),
                ms_text(latencies[str(row["region"])]),
                f"{on_demand[str(row['region']), str(row['type'])].usd_per_hour:.4f}",
                f"{usd.usd_per_hour:.4f}" if usd else "-",
                f"{usd.usd_per_hour * HOURS_A_MONTH:.2f}" if usd else "-",
                str(row["taken_a_month"] or "-"),
            )
        out = console()
        out.print(table)
        if len(shown) < len(rows):
            out.print(f"{len(rows) - len(shown)} more: --all")
        for line in latency_lines({str(row["region"]): latencies[str(row["region"])] for row in shown}):
            out.print(f"ms. {line}", style="dim")
        for source in _sources(provider):
            out.print(f"USD. {source}", style="dim")


def _show(question: Question, result: Answer) -> None:
    out = console()
    pool = result.independent
    out.print(
        f"[bold]replicas: {result.replicas}[/bold] ({len(result.choices)} to be added): none is up for "
        f"{result.p_system:.4%} of the time, and {question.target:.4%} is allowed; one is down for {result.p_vm:.3%}",
    )
    table = folding(Table("if machines", *_right("replicas", "none up", "in a year")))
    table.add_row("are placed as below", str(result.replicas), *_chance(result.p_system))
    table.add_row("are independent", str(pool.replicas), *_chance(pool.chance))
    if "spot" in question.kinds:
        table.add_row("so many share a region", str(pool.replicas), *_chance(pool.chance_in_one_region))
        here = pool.replicas_in_one_region
        table.add_row("share a region, for the target", *(("-", "never", "") if here is None else (str(here), "", "")))
        as_recorded = result.as_recorded
        table.add_row("stay as short as recorded", str(as_recorded.replicas), *_chance(as_recorded.chance))
    out.print(table)
    if result.choices:
        table = folding(Table("region", "type", "kind", "USD/h", "USD/month", "why", title="the choice"))
        for choice in result.choices:
            offer = choice.offer
            kind = "spot" if offer.is_spot else "on-demand"
            month = f"{offer.usd_per_hour * HOURS_A_MONTH:.2f}"
            table.add_row(offer.region, offer.type_name, kind, f"{offer.usd_per_hour:.4f}", month, choice.why)
        table.add_section()
        table.add_row("all", "", "", f"{result.usd_per_hour:.4f}", f"{result.usd_per_hour * HOURS_A_MONTH:.2f}", "")
        out.print(table)
    out.print("Assumed:")
    for line in result.assumptions:
        out.print(f"- {line}", style="dim")


def _document(question: Question, result: Answer) -> dict[str, object]:
    pool = result.independent
    return {
        "replicas": result.replicas,
        "target": question.target,
        "p_vm": result.p_vm,
        "p_system": result.p_system,
        "uptime_s": result.uptime_s,
        "recovery_s": result.recovery_s,
        "add": {
            "spot": sum(choice.offer.is_spot for choice in result.choices),
            "on-demand": sum(not choice.offer.is_spot for choice in result.choices),
        },
        "independent": {"replicas": pool.replicas, "p_system": pool.chance},
        "one_region": {
            "factor": result.factor,
            "p_system": pool.chance_in_one_region,
            "replicas": pool.replicas_in_one_region,
        },
        "as_recorded": {
            "uptime_s": measured().uptime_s,
            "replicas": result.as_recorded.replicas,
            "p_system": result.as_recorded.chance,
        },
        "choice": [
            {
                "provider": choice.offer.provider,
                "region": choice.offer.region,
                "type": choice.offer.type_name,
                "spot": choice.offer.is_spot,
                "usd_per_hour": choice.offer.usd_per_hour,
                "why": choice.why,
            }
            for choice in result.choices
        ],
        "usd_per_hour": round(result.usd_per_hour, 5),
        "usd_per_month": round(result.usd_per_hour * HOURS_A_MONTH, 2),
        "assumptions": list(result.assumptions),
    }


def _offers(provider: str, regions: list[str]) -> list[Offer]:
    offers = price_list(provider, Hardware(), regions=regions)
    if not offers:
        raise LocalError(f"--region {', '.join(regions)}: {provider} has {', '.join(regions_of(provider))}")
    return offers


def _positive(span: str) -> float:
    seconds = seconds_from_text(span)
    if seconds <= 0:
        raise LocalError(f"{span!r}: expected more than no time")
    return seconds


def _standing(texts: list[str]) -> dict[str, int]:
    standing = {"spot": 0, "on-demand": 0}
    for text in texts:
        kind, colon, count = text.partition(":")
        if kind not in standing or (colon and not (count.isascii() and count.isdigit())):
            raise LocalError(f"--have {text!r}: expected spot or on-demand, and how many: spot:2")
        standing[kind] += int(count or 1)
    return standing


def _latencies(texts: list[str]) -> dict[str, float]:
    latencies: dict[str, float] = {}
    for text in texts:
        region, _, number = text.partition("=")
        try:
            latencies[region] = float(number)
        except ValueError as error:
            raise LocalError(f"--latency {text!r}: expected a region and milliseconds: us-east-1=70") from error
    return latencies


def _sources(provider: str) -> tuple[str, ...]:
    return (
        aws_prices().sources if provider == "aws" else ("pretend prices, to try things out: no provider charges them",)
    )


def _chance(chance: float) -> tuple[str, str]:
    return f"{chance:.4%}", duration_text(round(chance * 365 * DAY_S, 2))


def _right(*headers: str) -> tuple[Column, ...]:
    return tuple(Column(header, justify="right") for header in headers)
