"""Generator of the data of ``fog.catalog``: a digest of the spot advisor with list prices, and spot trace statistics.

Command: reads ``scripts/data/spot``, writes ``fog/catalog/aws.json`` and ``traces.json``. One command:

    python scripts/make_catalog.py

The list prices below are those that AWS published for EC2 on-demand Linux machines (shared tenancy) in 2024, in USD an
hour. Those of c5 in the US, g6, p3 and p4d agree with SkyPilot's public catalogue (``catalogs/v7/aws/vms.csv``). Within
the families c5, c6i, m5, m6i, r5 and t3 the price is proportional to the size. Of machines with a GPU only the sizes
given are listed. A region that is missing was not known for sure.
"""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path
from typing import Final

from fog.plan.trace import Trace, outages, times_independent

ROOT: Final = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "scripts" / "bench"))
from machine import data_folder  # noqa: E402
from skeleton import clean_exit  # noqa: E402

TRACES: Final = "aws_*.json"
ADVISOR: Final = "spot-advisor-data.json"
SOURCES: Final = (
    "on-demand: AWS EC2 list prices, Linux, shared tenancy, 2024",
    "savings, interruption bands, CPUs and memory: AWS Spot Instance Advisor's data file, as stored with this project",
)
TRACES_SOURCE: Final = "aws r5.16xlarge, us-east-1b, c and d, 6.3 days in steps of 34 s (Can't Be Late, NSDI 2024)"

US: Final = ("us-east-1", "us-east-2", "us-west-2")  # these three have one price for all types below
SIZES: Final = {"large": 0.5, "xlarge": 1, "2xlarge": 2, "4xlarge": 4, "8xlarge": 8, "9xlarge": 9, "12xlarge": 12}
SIZES_ALSO: Final = {"16xlarge": 16, "18xlarge": 18, "24xlarge": 24}
# family -> price of its xlarge in US, and in other regions
BY_SIZE: Final[dict[str, tuple[float, dict[str, float]]]] = {
    "c5": (0.17, {"us-west-1": 0.212, "eu-west-1": 0.192, "eu-central-1": 0.194, "ap-northeast-1": 0.214}),
    "c6i": (0.17, {"eu-west-1": 0.1824, "eu-central-1": 0.194, "ap-northeast-1": 0.214}),
    "m5": (0.192, {"us-west-1": 0.224, "eu-west-1": 0.214, "eu-central-1": 0.23, "ap-northeast-1": 0.248}),
    "m6i": (0.192, {"eu-west-1": 0.214, "eu-central-1": 0.23, "ap-northeast-1": 0.248}),
    "r5": (0.252, {"us-west-1": 0.28, "eu-west-1": 0.282, "eu-central-1": 0.304, "ap-northeast-1": 0.304}),
    "t3": (0.1664, {"us-west-1": 0.1984, "eu-west-1": 0.1824, "eu-central-1": 0.192, "ap-northeast-1": 0.2176}),
}
# type -> its price in US, and in other regions; GPU, how many
WITH_GPU: Final[dict[str, tuple[float, dict[str, float], str, int]]] = {
    "g4dn.xlarge": (0.526, {"us-west-1": 0.631, "eu-west-1": 0.587, "eu-central-1": 0.658}, "T4", 1),
    "g4dn.2xlarge": (0.752, {}, "T4", 1),
    "g4dn.4xlarge": (1.204, {}, "T4", 1),
    "g4dn.8xlarge": (2.176, {}, "T4", 1),
    "g4dn.12xlarge": (3.912, {}, "T4", 4),
    "g5.xlarge": (1.006, {"eu-west-1": 1.123, "eu-central-1": 1.258}, "A10G", 1),
    "g5.2xlarge": (1.212, {}, "A10G", 1),
    "g5.4xlarge": (1.624, {}, "A10G", 1),
    "g5.12xlarge": (5.672, {}, "A10G", 4),
    "g6.2xlarge": (0.9776, {"eu-central-1": 1.22249, "ap-northeast-1": 1.41781}, "L4", 1),
    "p3.2xlarge": (3.06, {"eu-west-1": 3.305, "eu-central-1": 3.823, "ap-northeast-1": 4.194}, "V100", 1),
    "p3.8xlarge": (12.24, {"eu-west-1": 13.22, "eu-central-1": 15.292, "ap-northeast-1": 16.776}, "V100", 4),
    "p4d.24xlarge": (
        32.7726,
        {"eu-west-1": 35.39655, "eu-central-1": 40.94475, "ap-northeast-1": 44.92215},
        "A100",
        8,
    ),
}
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
    listed: dict[str, tuple[dict[str, float], str, int]] = {}
    for family, (usd, elsewhere) in BY_SIZE.items():
        for size, times in (SIZES | SIZES_ALSO | ({"medium": 0.25} if family == "t3" else {})).items():
            by_region = {region: round(each * times, 4) for region, each in _everywhere(usd, elsewhere).items()}
            listed[f"{family}.{size}"] = (by_region, "", 0)
    for name, (usd, elsewhere, gpu, gpus) in WITH_GPU.items():
        listed[name] = (_everywhere(usd, elsewhere), gpu, gpus)

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


def _everywhere(usd: float, elsewhere: dict[str, float]) -> dict[str, float]:
    return dict.fromkeys(US, usd) | elsewhere


def _write(name: str, items: dict[str, object]) -> None:
    path = ROOT / "fog/catalog" / name
    path.write_text(json.dumps(items, separators=(",", ":")) + "\n")
    print(f"{path.relative_to(ROOT)}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
