"""Probes of a node: does its loop run, and does it make progress?

Sans-I/O. The paths are those of Kubernetes: ``/livez`` fails when the process should be restarted, ``/readyz`` while it
should get no work, and ``/healthz`` in both cases.
Source: Kubernetes API health endpoints; liveness and readiness probes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Final

LIVE_S: Final = 10.0  # a loop that has not turned for so long hangs; it turns twice a second
PROBES: Final = ("/healthz", "/livez", "/readyz")


@dataclass(frozen=True, slots=True)
class Health:
    """State of a node as of its last look.

    Attributes:
        looked_s: monotonic second of the look; None: the loop has not turned yet.
        waiting: why the node makes no progress, as sentences; empty: it does.
    """

    looked_s: float | None = None
    waiting: tuple[str, ...] = ()


def probe(path: str, health: Health, now_s: float) -> tuple[bool, bytes]:
    """Return whether a probe of ``PROBES`` succeeds at a monotonic second, and the JSON object that says why not."""
    age_s = None if health.looked_s is None else max(now_s - health.looked_s, 0.0)
    is_live = age_s is None or age_s < LIVE_S  # a start takes as long as it takes; it is not ready meanwhile
    is_ready = age_s is not None and is_live and not health.waiting
    fields = {
        "live": is_live,
        "ready": is_ready,
        "loop_age_s": None if age_s is None else round(age_s, 3),
        "waiting": list(health.waiting),
    }
    is_good = {"/livez": is_live, "/readyz": is_ready}.get(path, is_live and is_ready)
    return is_good, json.dumps(fields).encode() + b"\n"
