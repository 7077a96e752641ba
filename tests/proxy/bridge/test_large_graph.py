"""A graph with many names: a change of one asks the rules about that one alone."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from proxy.bridge.core import desired_flows
from proxy.config.rule import Rule
from tests.proxy.bridge.known import STRING
from tests.proxy.bridge.sites import ROBOT, SERVER, Machine, Sites, named

NAMES = 300


def filled(sites: Sites, label: str) -> Machine:
    """Return a machine with many topics, of which rules carry some in each direction."""
    holds = [named(f"/t/{number}") for number in range(0, NAMES, 3)]
    machine = sites.add(label, expose=["name: /t/*"], imports=["name: /t/*"], holds=holds)
    for number in range(NAMES):
        if number % 2:
            machine.graph.publish(f"/n{number % 20}", f"/t/{number}", STRING)
        else:
            machine.graph.subscribe(f"/n{number % 20}", f"/t/{number}", STRING, lambda _: None)
    sites.run(3.0)
    return machine


def test_a_new_name_costs_no_look_at_the_rules_of_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sites = Sites(tmp_path)
    machine = filled(sites, ROBOT)
    before = machine.carried
    asked = Counter[str]()
    for name in "matches", "overlay_name_of", "local_of":
        call = getattr(Rule, name)

        def counted(*arguments: object, call: object = call, name: str = name) -> object:
            asked[name] += 1
            return call(*arguments)  # type: ignore[operator]

        monkeypatch.setattr(Rule, name, counted)
    talker = machine.graph.publish("/n1", "/t/0", STRING)
    sites.run(1.0)
    assert machine.carried - before == {("/t/0", True)}
    assert 0 < sum(asked.values()) < 30
    asked.clear()
    talker.close()
    sites.run(1.0)
    assert machine.carried == before
    assert sum(asked.values()) < 30


def test_a_reload_asks_the_new_rules_about_every_name(tmp_path: Path) -> None:
    sites = Sites(tmp_path)
    machine = filled(sites, SERVER)
    assert len(machine.carried) > NAMES / 4
    machine.bridge.reload(sites.config(["name: /t/1"], [], 2), machine.bridge.held)
    sites.run(1.0)
    assert machine.carried <= {("/t/1", True)}
    machine.bridge.reload(sites.config(["name: /t/*"], ["name: /t/*"], 2), machine.bridge.held)
    sites.run(1.0)
    assert len(machine.carried) > NAMES / 4


def test_what_is_kept_of_names_that_come_and_go_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(desired_flows, "_KEPT_MIN", 10)
    sites = Sites(tmp_path)
    machine = sites.add(ROBOT, expose=["name: /t/*"], holds=[])
    for number in range(60):
        talker = machine.graph.publish("/n", f"/t/{number}", STRING)
        sites.run(0.05)
        talker.close()
        sites.run(0.05)
    (memo,) = machine.bridge._memos
    assert 0 < len(memo.exposed) <= 15
