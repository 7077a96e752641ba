"""Counters of the robot's proxies, read by the supervisor."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from fog.site import Site, open_site
from fog.supervisor.proxy_metrics import received_by, sent_by
from gdp.crypto.certificates import Role
from gdp.management.control_client import control_path
from gdp.management.control_socket import ControlHandlers, serve_control_in_thread
from gdp.nodes.membership import load_member
from gdp.telemetry.metrics import Metrics
from gdp.telemetry.sources import Sources
from proxy.config.config import ProxyConfig


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


@pytest.mark.parametrize(
    ("counters", "sent", "received"), [({"messages": {"in": 3, "out": 41}}, 41, 3), ({}, None, None)]
)
def test_counters_come_from_the_control_socket(
    site: Site, tmp_path: Path, counters: dict[str, object], sent: int | None, received: int | None
) -> None:
    (path,) = site.robots
    config = ProxyConfig.load(path)
    name = load_member(config.identity, config.domain, Role.PROXY)[0].name
    handlers = ControlHandlers(reload=lambda: None, status=lambda: {"counters": counters}, drain=lambda: None)
    socket_file = control_path(name)
    socket_file.parent.mkdir(mode=0o755, exist_ok=True)
    with serve_control_in_thread(socket_file, handlers):
        assert sent_by(path) == sent
        assert received_by(name.to_text()) == received


def test_a_proxy_that_does_not_run_has_no_counters(site: Site) -> None:
    assert sent_by(site.robots[0]) is None
    assert received_by("ab" * 32) is None
