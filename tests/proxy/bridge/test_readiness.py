"""Readiness probes: remote clients find a server only while it passes."""

from __future__ import annotations

from pathlib import Path

import pytest

from proxy.bridge.cancellation import TRIGGER
from proxy.bridge.readiness import Thresholds
from tests.proxy.bridge.clients import Client, LocalServer
from tests.proxy.bridge.known import SET_BOOL, STRING, string, switch, switched
from tests.proxy.bridge.sites import ROBOT, SERVER, Machine, Sites
from tests.proxy.rule_files import furnish, refusals, rules

SWITCH = f"kind: service, name: /switch, type: {SET_BOOL}"
YES, NO = b"\0\1\0\0\1\0\0\0\1\0\0\0\0", b"\0\1\0\0\0\0\0\0\1\0\0\0\0"
PROBE = "period_s: 0.2, timeout_s: 0.1"


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def pair(sites: Sites, readiness: str) -> tuple[Machine, Client]:
    """Return a machine with a server that answers, and a client elsewhere."""
    server = sites.add(SERVER, expose=[f"{SWITCH}, readiness: {{{readiness}}}"])
    client = sites.add(ROBOT, imports=[SWITCH])
    LocalServer(server.graph, answer=lambda raw: switched(f"got {raw[-1]}"))
    return server, Client(client.graph)


def test_a_server_is_found_once_its_probe_succeeds_and_is_called(sites: Sites) -> None:
    server, client = pair(sites, f"service: /ready, {PROBE}")
    answers = [NO, NO, YES]
    probe = LocalServer(server.graph, "/ready", TRIGGER, answer=lambda _: answers.pop(0) if answers[1:] else answers[0])
    assert not sites.run(0.35, client.sees_server)
    assert sites.run(2, client.sees_server)
    assert probe.asked >= 3
    client.call(switch(on=True))
    assert sites.run(1, lambda: client.outcomes == [switched("got 1")])


def test_a_server_whose_probe_fails_is_left_after_as_many_failures_as_the_rule_says(sites: Sites) -> None:
    server, client = pair(sites, f"service: /ready, failure_threshold: 2, {PROBE}")
    answers = [YES]
    probe = LocalServer(server.graph, "/ready", TRIGGER, answer=lambda _: answers[0])
    assert sites.run(2, client.sees_server)
    answers[0] = NO
    before = probe.asked
    assert sites.run(2, lambda: not client.sees_server())
    assert probe.asked - before >= 2
    assert server.bridge.unready == [("/switch", "/ready answers success: false")]
    answers[0] = YES
    assert sites.run(2, client.sees_server)


def test_a_probe_without_an_answer_fails(sites: Sites) -> None:
    server, client = pair(sites, f"service: /ready, {PROBE}")
    LocalServer(server.graph, "/ready", TRIGGER)
    assert not sites.run(1, client.sees_server)
    assert server.bridge.unready == [("/switch", "/ready: no answer within 0.1 s")]


def test_a_topic_that_ticks_makes_ready_and_its_silence_does_not(sites: Sites) -> None:
    server, client = pair(sites, f"topic: /beat, type: {STRING}, period_s: 0.2, failure_threshold: 2")
    beat = server.graph.publish("/server", "/beat", STRING)
    assert not sites.run(1, client.sees_server)
    sites.every(0.1, 20, lambda _: beat.publish(string("tick")))
    assert sites.run(1, client.sees_server)
    assert sites.run(3, lambda: not client.sees_server())
    assert server.bridge.unready == [("/switch", "/beat is silent")]


def test_a_reload_that_changes_a_probe_ends_the_one_before(sites: Sites) -> None:
    server, client = pair(sites, f"service: /ready, {PROBE}")
    probes = [LocalServer(server.graph, name, TRIGGER, answer=lambda _: YES) for name in ("/ready", "/ready2")]
    assert sites.run(2, client.sees_server)
    handles = server.endpoint.handles
    sites.reload(server, expose=[f"{SWITCH}, readiness: {{service: /ready2, {PROBE}}}"])
    sites.run(1)
    before = probes[0].asked
    assert sites.run(2, lambda: probes[1].asked >= 3)
    assert client.sees_server()
    assert (probes[0].asked, server.endpoint.handles) == (before, handles)


def test_thresholds_count_results_in_a_row() -> None:
    ready = Thresholds(failures=2, successes=3)
    results = [True, True, False, True, True, True, False, True, False, False]
    assert [ready.add(is_success=each) for each in results].index(True) == 5
    assert not ready.is_ready


@pytest.mark.parametrize(
    ("readiness", "error"),
    [
        ("period_s: 1", "expected either service or topic"),
        ("service: /a, topic: /b", "expected either service or topic"),
        ("topic: /b", "topic needs a type as ROS 2 writes it"),
        (f"service: /a, type: {STRING}", "type is for topic"),
        ("service: a", "expected a full ROS name"),
    ],
)
def test_a_probe_that_cannot_be_is_refused(tmp_path: Path, readiness: str, error: str) -> None:
    furnish(tmp_path)
    text = f"ros: {{endpoint: ros2, domain: 0}}\nexpose:\n{rules(f'{SWITCH}, readiness: {{{readiness}}}')}"
    assert error in refusals(tmp_path, text)[0]


def test_a_probe_stands_under_expose(tmp_path: Path) -> None:
    furnish(tmp_path)
    text = f"ros: {{endpoint: ros2, domain: 0}}\nimport:\n{rules(f'{SWITCH}, readiness: {{service: /a}}')}"
    assert "this stands in rules under expose" in refusals(tmp_path, text)[0]
