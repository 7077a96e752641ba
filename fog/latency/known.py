"""Known latencies of regions: stated in ``fog.yaml``, else measured recently, else unknown.

I/O; stores measurements in ``latency.json`` of the state folder, which any process of the site may read and replace.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from fog.latency.config import LatencyConfig, ProbeEndpoint
from fog.latency.probe import Probed, probe_all
from fog.plan.duration import duration_text
from gdp.errors import StoreError
from gdp.intervals import CACHE_S

log = logging.getLogger(__name__)

_FILE: Final = "latency.json"
NO_ENDPOINT: Final = "not measured: latency.endpoints of fog.yaml names no endpoint"
_EARLY: Final = 0.5  # share of its lifetime after which a measurement is repeated


@dataclass(frozen=True, slots=True)
class Latency:
    """Latency of a region.

    Args:
        ms: round trip; None: unknown.
        source: source of the figure, or why there is none.
    """

    ms: float | None
    source: str


@dataclass(frozen=True, slots=True)
class _Kept:
    endpoint: str
    ms: float | None
    reason: str
    unix_s: float


class Latencies:
    """Latencies of a site's regions; ``stated``: region -> ms; takes precedence over measurements."""

    def __init__(
        self,
        folder: Path,
        config: LatencyConfig,
        stated: Mapping[str, float],
        measure: Callable[[Mapping[str, ProbeEndpoint], float], dict[str, Probed]] = probe_all,
    ) -> None:
        self._path = folder / _FILE
        self._config = config
        self._stated = stated
        self._measure = measure
        self._refreshing: threading.Thread | None = None

    def refresh(self, regions: Iterable[str], now_unix_s: float) -> None:
        """Measure regions whose measurement is missing or past half of its lifetime; wait for the results.

        Raises:
            StoreError: the measurements cannot be stored.
        """
        kept = self._read()
        due = {
            region: endpoint
            for region in dict.fromkeys(regions)
            if region not in self._stated
            and (endpoint := self._config.endpoint(region)) is not None
            and not self._holds(kept.get(region), endpoint, now_unix_s)
        }
        if not due:
            return
        found = self._measure(due, self._config.timeout_s)
        more = {
            region: _Kept(due[region].to_text(), each.ms, each.reason, now_unix_s) for region, each in found.items()
        }
        self._write({**self._read(), **more})

    def refresh_in_background(self, regions: Iterable[str], now_unix_s: float) -> None:
        """Call ``refresh`` in a thread; at most one runs at a time."""
        if self._refreshing is not None and self._refreshing.is_alive():
            return
        names = tuple(regions)

        def work() -> None:
            try:
                self.refresh(names, now_unix_s)
            except StoreError as error:
                log.warning("latency not kept reason=%s", error)

        self._refreshing = threading.Thread(target=work, name="measures latency", daemon=True)
        self._refreshing.start()

    def lookup(self, regions: Iterable[str], now_unix_s: float) -> dict[str, Latency]:
        """Return the known latency of each region without measuring."""
        kept = self._read()
        return {region: self._one(region, kept.get(region), now_unix_s) for region in dict.fromkeys(regions)}

    def ms(self, regions: Iterable[str], now_unix_s: float) -> dict[str, float]:
        """Return region -> ms for the regions with a known latency."""
        return {region: each.ms for region, each in self.lookup(regions, now_unix_s).items() if each.ms is not None}

    def _one(self, region: str, kept: _Kept | None, now_unix_s: float) -> Latency:
        if region in self._stated:
            return Latency(self._stated[region], "latency_ms of fog.yaml")
        endpoint = self._config.endpoint(region)
        if endpoint is None:
            return Latency(None, NO_ENDPOINT)
        if kept is None or kept.endpoint != endpoint.to_text():
            return Latency(None, f"not measured yet: {endpoint.to_text()}")
        age_s = max(now_unix_s - kept.unix_s, 0.0)
        ago = f"{duration_text(round(age_s))} ago" if age_s >= 1 else "now"
        if kept.ms is None:
            return Latency(None, f"unreachable {ago}: {kept.endpoint}: {kept.reason}")
        if age_s > self._config.lifetime_s:
            return Latency(None, f"too old: measured {ago}, {kept.endpoint}")
        return Latency(kept.ms, f"measured {ago}, {kept.endpoint}")

    def _holds(self, kept: _Kept | None, endpoint: ProbeEndpoint, now_unix_s: float) -> bool:
        if kept is None or kept.endpoint != endpoint.to_text() or kept.unix_s > now_unix_s:
            return False
        limit_s = CACHE_S if kept.ms is None else self._config.lifetime_s * _EARLY
        return now_unix_s - kept.unix_s < limit_s

    def _read(self) -> dict[str, _Kept]:
        try:
            return {region: _Kept(**each) for region, each in json.loads(self._path.read_bytes()).items()}
        except (OSError, ValueError, TypeError, AttributeError, RecursionError):
            # missing, or written by another version: regions are measured again
            return {}

    def _write(self, kept: Mapping[str, _Kept]) -> None:
        fresh = self._path.with_suffix(f".{os.getpid()}-{threading.get_ident()}")
        try:
            fresh.write_text(json.dumps({region: asdict(each) for region, each in kept.items()}), encoding="utf-8")
            fresh.replace(self._path)
        except OSError as error:
            raise StoreError(f"{self._path}: {error.strerror}") from error
