from __future__ import annotations

import socket
from pathlib import Path

import pytest

from fog.site import Site, open_site
from fog.supervisor.robot_calls import sent_by
from gdp.telemetry.metrics import Metrics
from gdp.telemetry.sources import Sources


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return open_site(None, tmp_path / "state")


def free_port() -> int:
    with socket.socket() as each:
        each.bind(("127.0.0.1", 0))
        return int(each.getsockname()[1])


def test_a_proxy_that_shows_its_metrics_tells_how_much_it_sent(site: Site) -> None:
    (path,), port = site.robots, free_port()
    path.write_text(f"{path.read_text()}metrics: {{port: {port}}}\n")
    assert sent_by(path) is None  # it does not run
    metrics = Metrics(Sources(messages=lambda: {"in": 3, "out": 41}))
    metrics.serve(port)
    assert sent_by(path) == 41
    metrics.close()


def test_a_proxy_without_metrics_does_not_tell(site: Site) -> None:
    assert sent_by(site.robots[0]) is None
