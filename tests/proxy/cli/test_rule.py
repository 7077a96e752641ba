"""``gdp rule``: rules of a running proxy, changed by command."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from proxy.config.config import ProxyConfig
from tests.gdp.sharing.machines import IMAGE, Machine, Site

Run = Callable[..., "tuple[int, str, str]"]


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    machine = Site(tmp_path).add("robot", "# a comment that stays\ndeny: [/never]\n")
    monkeypatch.chdir(machine.folder)
    return machine


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def run(*words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as leaving:
            main(["rule", *words])
        shown = capsys.readouterr()
        return int(leaving.value.code or 0), shown.out, shown.err

    return run


def config(robot: Machine) -> ProxyConfig:
    return ProxyConfig.load(robot.folder / "proxy.yaml")


def test_a_rule_is_added_at_once_to_the_running_proxy(robot: Machine, run: Run) -> None:
    before = (robot.folder / "proxy.yaml").read_text()
    with ExitStack() as stack:
        robot.start(stack)
        words = ("--type", IMAGE, "--owner", "owner/owner.pub", "--set", "max_hz=5", "--set", "priority=urgent")
        assert run("add", "expose", "/camera/image", *words)[:2] == (0, "added expose /camera/image: now\n")
        (rule,) = robot.config.expose if robot.config else ()
    assert (rule.name, rule.max_hz, rule.priority) == ("/camera/image", 5, "urgent")
    assert (robot.folder / "proxy.yaml").read_text() == before


def test_a_removed_rule_is_gone_and_its_file_too(robot: Machine, run: Run) -> None:
    run("add", "import", "/camera/**", "--owner", "owner/owner.pub")
    code, shown, _ = run("remove", "import", "/camera/**")
    assert (code, shown) == (0, "removed import /camera/**: at the next start of the proxy\n")
    assert not config(robot).imports
    assert not list((robot.folder / "proxy.yaml.d").iterdir())


def test_a_name_is_denied_by_command(robot: Machine, run: Run) -> None:
    assert run("add", "deny", "/camera/raw/**")[0] == 0
    assert config(robot).deny == ("/never", "/camera/raw/**")
    assert run("remove", "deny", "/camera/raw/**")[0] == 0
    assert config(robot).deny == ("/never",)


def test_a_rule_has_the_owner_that_the_file_states_for_all(tmp_path: Path, run: Run) -> None:
    robot = Site(tmp_path).add("robot", "owner: owner/owner.pub\n")
    where = ("--config", str(robot.folder / "proxy.yaml"))
    assert run("add", "import", "/camera/**", *where)[0] == 0
    assert config(robot).imports[0].owner == config(robot).owner


def test_a_refused_rule_changes_nothing_and_says_why(robot: Machine, run: Run) -> None:
    run("add", "expose", "/a", "--owner", "owner/owner.pub")
    code, _, error = run("add", "expose", "/b", "--owner", "owner/owner.pub", "--set", "max_hz=-1")
    assert code == 2
    assert "expose[1].max_hz: expected greater than 0" in error
    assert [rule.name for rule in config(robot).expose] == ["/a"]


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("add", "expose", "/a"), "state the owner's public key with --owner FILE"),
        (("add", "sideways", "/a"), "expected expose, import or deny"),
        (("add", "deny", "/never"), "deny /never is there already"),
        (("add", "expose", "/a", "--owner", "owner/owner.pub", "--set", "max_hz"), "expected KEY=VALUE"),
        (("remove", "deny", "/never"), "was not added by 'gdp rule'; edit that file"),
        (("remove", "expose", "/b"), "no rule expose /b; 'gdp rule add' made: none"),
    ],
)
def test_wrong_use_says_what_to_do(robot: Machine, run: Run, words: tuple[str, ...], error: str) -> None:
    code, _, shown = run(*words)
    assert code == 2
    assert error in shown


def test_the_list_has_the_place_of_each_rule(robot: Machine, run: Run) -> None:
    run("add", "expose", "/a", "--owner", "owner/owner.pub")
    rules = json.loads(run("list", "--json")[1])["rules"]
    assert [(each["list"], each["rule"]["name"], each["removable"]) for each in rules] == [
        ("deny", "/never", False),
        ("expose", "/a", True),
    ]
    assert rules[1]["where"] == f"{robot.folder / 'proxy.yaml.d' / 'gdp-rule.yaml'}:3:3"
