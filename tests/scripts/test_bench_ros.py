"""Sans-I/O parts of the benches with real ROS nodes: names, cases and targets."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[2] / "scripts" / "bench"))

import ros
import services
from report import Rounds
from ros_row import Carried
from ros_stage import DIRECT, Bench, parse
from skeleton import Options

from gdp.metadata import Metadata
from gdp.stores.issue import make_owner
from gdp.stores.keyring import OWNER_PUBLIC
from lab.topology import LEFT, RIGHT
from proxy.config.rule import Rule


@pytest.fixture
def options(monkeypatch: pytest.MonkeyPatch) -> Options:
    monkeypatch.setattr(sys, "argv", ["bench"])
    return parse("", rounds=3, seconds=5.0, mtus=(1_500, 9_000), quick_s=1.0)


def benches(options: Options) -> list[Bench]:
    return [ros.bench_of(options), services.bench_of(options)]


def test_what_is_carried_is_named_once_and_has_a_source_at_an_end(options: Options) -> None:
    for bench in benches(options):
        names = [each.name for each in bench.carried]
        assert len(set(names)) == len(names)
        assert {each.source for each in bench.carried} <= {LEFT, RIGHT}


def test_the_proxies_carry_all_that_nodes_of_the_overlay_use(options: Options) -> None:
    carried = [{each.name for each in bench.carried} for bench in benches(options)]
    used = [
        {topic for kind, each in ros.ENCODINGS.items() for encoding in each for topic in ros.topics_of(kind, encoding)},
        {services.service_of(encoding) for each in services.ENCODINGS.values() for encoding in each}
        | {services.service_of("cdr", services.SESSION)},
    ]
    assert carried == used


def test_every_rule_is_one_that_the_proxy_takes_and_means_what_the_owner_delegates(
    options: Options, tmp_path: Path
) -> None:
    make_owner(tmp_path / "owner")
    owner = tmp_path / "owner" / OWNER_PUBLIC
    for bench in benches(options):
        for each in bench.carried:
            rule = Rule.model_validate(each.at_proxies.rule(owner))
            assert rule.metadata_of(each.name, each.type_name) == each.at_proxies.metadata


def test_a_carried_thing_says_its_kind_name_and_type() -> None:
    lamp = Carried("/lamp", "std_srvs/srv/SetBool", "json", source=RIGHT, kind="service")
    assert lamp.at_proxies.metadata == Metadata({"kind": "service", "name": "/lamp", "type": "std_srvs/srv/SetBool"})


def test_every_case_is_measured_directly_too(options: Options) -> None:
    for bench in benches(options):
        cases = {turn.case for turn in bench.turns}
        assert cases == {turn.case for turn in bench.turns if turn.contender == DIRECT}
        assert cases == {turn.case for turn in bench.turns if turn.contender != DIRECT}


def test_targets_are_compared_with_the_results_of_the_rounds(options: Options) -> None:
    for bench in benches(options):
        over = Rounds()
        for turn in bench.turns:
            for column in turn.columns:
                over.add(turn.contender, turn.case, column, 0.0)
        targets = bench.targets(over)
        assert targets
        assert [target.what for target in targets if target.measured is None and " / " not in target.what] == []
        assert all(target.met for target in targets if target.target is not None)
        assert all(panel.bars for panel in bench.panels(over) if panel.title in over.cases())


def test_a_quick_run_is_quick_in_its_first_round_too(options: Options) -> None:
    assert ros.first_s(options) == ros.LONG_S
    options.quick = True
    assert ros.first_s(options) == options.seconds
