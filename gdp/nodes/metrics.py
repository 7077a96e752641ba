"""Metrics of a node on a loopback port. I/O."""

from __future__ import annotations

from collections.abc import Callable

from gdp.telemetry.sources import Sources

__all__ = ["serve_metrics"]


def serve_metrics(sources: Sources, port: int) -> Callable[[], None]:
    """Serve metrics on a loopback port; return the function that ends it."""
    from gdp.telemetry.metrics import Metrics  # loads prometheus_client, which a node without metrics does without

    metrics = Metrics(sources)
    metrics.serve(port)
    return metrics.close
