"""What a forwarding table costs a switch: resident memory, bytes an entry, time to install and to expire.

    .venv/bin/python scripts/bench/table.py [--entries 100000] [--json FILE]

The process imports all that a switch runs on, so its size is a switch's. Half of the entries are for a destination,
half for destination and source, with eight different sets of hops and leases that end one after the other.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import os
import pkgutil
import resource
import time
from pathlib import Path

import gdp.ports.raw
import gdp.switch
from gdp.switch.table import Table


def resident_mib() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / (1 << 20)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--entries", type=int, default=100_000)
    parser.add_argument("--json", type=Path, help="also write the result to this file")
    options = parser.parse_args()
    for module in pkgutil.iter_modules(gdp.switch.__path__, "gdp.switch."):
        importlib.import_module(module.name)
    for name in ("gdp.nodes.switch", "gdp.cli.switch"):
        if importlib.util.find_spec(name):
            importlib.import_module(name)
    before, table = resident_mib(), Table()
    hops = [((port % 4, os.urandom(12)),) for port in range(8)]
    keys = (os.urandom(32 + 32 * (at % 2)) for at in range(options.entries))
    start = time.perf_counter()
    for at, key in enumerate(keys):
        table.install(key, hops[at % 8], float(at))
    installed, full = time.perf_counter() - start, resident_mib()
    start = time.perf_counter()
    gone = len(table.expire(options.entries / 2))
    expired = time.perf_counter() - start
    result = {
        "entries": options.entries,
        "resident_mib": round(full, 1),
        "resident_before_mib": round(before, 1),
        "bytes_per_entry": round((full - before) * (1 << 20) / options.entries),
        "install_us": round(installed / options.entries * 1e6, 2),
        "expire_us": round(expired / gone * 1e6, 2),
    }
    for key, value in result.items():
        print(f"{key:22}{value:>12}")
    if options.json:
        options.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
