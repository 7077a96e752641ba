"""Generator of the data of ``fog.catalog``: a digest of the spot advisor with list prices, and spot trace statistics.

Command: reads ``scripts/data/spot``, writes ``fog/catalog/aws.json`` and ``traces.json``. One command:

    python scripts/make_catalog.py
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import yaml

ROOT: Final = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "scripts" / "bench"))
from machine import data_folder  # noqa: E402
from skeleton import clean_exit  # noqa: E402
from spot_trace import Trace, outages, times_independent  # noqa: E402

TRACES: Final = "aws_*.json"
ADVISOR: Final = "spot-advisor-data.json"
PRICES: Final = "list_prices.yaml"
SOURCES: Final = (
    "on-demand: AWS EC2 list prices, Linux, shared tenancy, 2024",
    "savings, interruption bands, CPUs and memory: AWS Spot Instance Advisor's data file, as stored with this project",
)
TRACES_SOURCE: Final = "aws r5.16xlarge, us-east-1b, c and d, 6.3 days in steps of 34 s (Can't Be Late, NSDI 2024)"

US: Final = ("us-east-1", "us-east-2", "us-west-2")
SIZES: Final = {
    "large": 0.5, "xlarge": 1, "2xlarge": 2, "4xlarge": 4, "8xlarge": 8, "9xlarge": 9, "12xlarge": 12, "16xlarge": 16,
    "18xlarge": 18, "24xlarge": 24,
}  # fmt: skip
SPANS_S: Final = (300, 600, 1200, 1800)


def main() -> None:
    """Write both files."""
    with clean_exit():
        _write("aws.json", prices())
        _write("traces.json", traces())


def prices() -> dict[str, object]:
    """Return types, and for each region and type: USD an hour, savings of spot in percent, interruption band."""
    advisor = json.loads((data_folder("spot", [ADVISOR]) / ADVISOR).read_text())
    known = advisor["instance_types"]
    published = yaml.safe_load((data_folder("spot", [PRICES]) / PRICES).read_text(encoding="utf-8"))
    listed: dict[str, tuple[dict[str, float], str, int]] = {}
    for family, usd in published["families"].items():
        for size, times in (SIZES | ({"medium": 0.25} if family == "t3" else {})).items():
            by_region = {region: round(each * times, 4) for region, each in _everywhere(usd).items()}
            listed[f"{family}.{size}"] = (by_region, "", 0)
    for name, (gpu, gpus, usd) in published["with_gpu"].items():
        listed[name] = (_everywhere(usd), gpu, gpus)

    types: dict[str, list[str | int | float]] = {}
    regions: dict[str, dict[str, list[float | int | None]]] = {}
    for name, (by_region, gpu, gpus) in listed.items():
        if name not in known:  # not every family has every size
            continue
        types[name] = [known[name]["cores"], known[name]["ram_gb"], gpu, gpus]
        for region, usd in by_region.items():
            spot = advisor["spot_advisor"][region]["Linux"].get(name, {})
            regions.setdefault(region, {})[name] = [usd, spot.get("s"), spot.get("r")]
    bands = [each["label"] for each in advisor["ranges"]]
    return {"sources": SOURCES, "bands": bands, "types": types, "regions": regions}


def traces() -> dict[str, object]:
    """Return statistics of the traces: uptime, and simultaneous failures."""
    zones = [
        Trace.from_document(path.stem.rsplit("_", 1)[1], json.loads(path.read_text()))
        for path in sorted(data_folder("spot", [TRACES]).glob(TRACES))
    ]
    lost = sum(len(zone.preemptions) for zone in zones)
    free_s = sum(float((~zone.taken).sum()) * zone.step_s for zone in zones)
    taken_s = sum(float(zone.taken.sum()) * zone.step_s for zone in zones)
    return {
        "source": TRACES_SOURCE,
        "uptime_s": round(free_s / lost, 1),
        "back_s": round(taken_s / lost, 1),
        "taken_share": {zone.zone: round(float(zone.taken.mean()), 4) for zone in zones},
        "all_free_together": round(times_independent(*(~zone.taken for zone in zones)), 2),
        "pairs": [
            {
                "zones": [one.zone, other.zone],
                "free_together": round(times_independent(~one.taken, ~other.taken), 2),
                "taken_together": round(times_independent(one.taken, other.taken), 2),
                "outages_together": {
                    span_s: round(times_independent(outages(one, span_s), outages(other, span_s)), 2)
                    for span_s in SPANS_S
                },
            }
            for one, other in itertools.combinations(zones, 2)
        ],
    }


def _everywhere(usd: Mapping[str, float]) -> dict[str, float]:
    """Return prices by region; ``us`` stands for three."""
    return dict.fromkeys(US, usd["us"]) | {region: each for region, each in usd.items() if region != "us"}


def _write(name: str, items: dict[str, object]) -> None:
    path = ROOT / "fog/catalog" / name
    path.write_text(json.dumps(items, separators=(",", ":")) + "\n")
    print(f"{path.relative_to(ROOT)}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
