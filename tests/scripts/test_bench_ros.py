"""Sans-I/O parts of the bench with real ROS nodes: names, cases and targets."""

from __future__ import annotations

import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

sys.path.append(str(Path(__file__).resolve().parents[2] / "scripts" / "bench"))

import ros
from report import Rounds
from skeleton import Options, Trial

from gdp.metadata import Metadata
from gdp.stores.issue import make_owner
from gdp.stores.keyring import OWNER_PUBLIC
from lab.credentials import Carried
from lab.topology import LEFT, RIGHT
from proxy.config.rule import Rule

EVERY = pytest.mark.parametrize("options", [ros.command([]), ros.command(["--calls"])], ids=["topics", "calls"])


def trials(options: Options) -> list[Trial]:
    return list(ros.trials_of({mtu: Mock() for mtu in options.mtu}, options))


def test_what_is_carried_is_named_once_and_has_a_source_at_an_end() -> None:
    names = [each.name for carried in ros.CARRIED.values() for each in carried]
    assert len(set(names)) == len(names)
    assert ros.CARRIED.keys() <= {LEFT, RIGHT}
    assert {topic for each in ros.STREAMS.values() for topic in each.topics} | {*ros.SERVICES.values()} == {*names}


def test_every_rule_is_one_that_the_proxy_takes_and_means_what_the_owner_delegates(tmp_path: Path) -> None:
    make_owner(tmp_path / "owner")
    owner = tmp_path / "owner" / OWNER_PUBLIC
    for each in (each for carried in ros.CARRIED.values() for each in carried):
        rule = Rule.model_validate(each.rule(owner))
        assert rule.metadata_of(each.name, each.type_name) == each.metadata


def test_a_carried_thing_says_its_kind_name_and_type() -> None:
    lamp = Carried("/lamp", "std_srvs/srv/SetBool", "service")
    assert lamp.metadata == Metadata({"kind": "service", "name": "/lamp", "type": "std_srvs/srv/SetBool"})


@EVERY
def test_every_case_is_measured_directly_too(options: Options) -> None:
    cases = {trial.case for trial in trials(options)}
    assert cases == {trial.case for trial in trials(options) if trial.baseline == ros.DIRECT}
    assert cases == {trial.case for trial in trials(options) if trial.baseline == ros.OVERLAY}


@EVERY
def test_targets_are_compared_with_the_results_of_the_rounds(options: Options) -> None:
    over = Rounds()
    for trial in trials(options):
        for column in trial.columns:
            over.add(trial.baseline, trial.case, column, 0.0)
    targets = ros.targets_of(over, options)
    assert targets
    assert [target.what for target in targets if target.measured is None] == []
    assert all(target.met for target in targets if target.target is not None)
