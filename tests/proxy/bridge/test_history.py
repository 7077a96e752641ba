"""``history`` of a rule: a machine that joins late gets more than 64 messages."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.proxy.bridge.known import STRING, string
from tests.proxy.bridge.sites import ROBOT, SERVER, Ear, Sites
from tests.proxy.rule_files import furnish, refusals, rules

EVENTS = f"name: /events, type: {STRING}"


@pytest.fixture
def sites(tmp_path: Path) -> Sites:
    return Sites(tmp_path)


def test_a_machine_that_joins_late_gets_what_is_kept(sites: Sites) -> None:
    robot = sites.add(ROBOT, expose=[f"{EVENTS}, history: 200"])
    talker = robot.graph.publish("/talker", "/events", STRING)
    sites.run(1)
    for number in range(300):
        talker.publish(string(str(number)))
    sites.run(1)
    server = sites.add(SERVER, imports=[EVENTS])
    ear = Ear(server.graph, "/events")
    assert sites.run(5, lambda: len(ear.texts) == 200)
    assert ear.texts == [str(number) for number in range(100, 300)]


@pytest.mark.parametrize(
    ("keys", "error"),
    [
        ("history: {bytes: 0}", "expected greater than or equal to 1"),
        ("history: {age_s: 0}", "expected greater than 0"),
        ("latched: false, history: 5", "leave out 'latched: false'"),
        ("kind: service, history: 5", "only topics have this"),
    ],
)
def test_an_impossible_history_is_refused(tmp_path: Path, keys: str, error: str) -> None:
    furnish(tmp_path)
    assert error in refusals(tmp_path, f"ros: {{endpoint: ros2}}\nexpose:\n{rules(f'name: /a, {keys}')}")[0]
