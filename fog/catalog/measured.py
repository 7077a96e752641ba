"""Measurements of spot machines, as shipped.

I/O; reads one file of this package, which ``git show 55cf6b3c:scripts/make_catalog.py`` computed.
"""

from __future__ import annotations

import functools
import json
from importlib import resources

from fog.plan.evidence import Measured, Pair


@functools.cache
def measured() -> Measured:
    """Return the measurements; the file is read once per process."""
    items = json.loads(resources.files("fog.catalog").joinpath("traces.json").read_bytes())
    pairs = tuple(
        Pair(
            (each["zones"][0], each["zones"][1]),
            each["free_together"],
            each["taken_together"],
            {int(span): ratio for span, ratio in each["outages_together"].items()},
        )
        for each in items["pairs"]
    )
    return Measured(
        source=items["source"],
        uptime_s=items["uptime_s"],
        back_s=items["back_s"],
        taken_share=items["taken_share"],
        pairs=pairs,
        all_free_together=items["all_free_together"],
    )
