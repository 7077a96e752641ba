"""``gdp-delegate``, as called by a person."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gdp.cli.delegate import main as alias
from gdp.cli.gdp import main
from gdp.stores.issue import delegate
from gdp.stores.keyring import load_delegations, save_delegation
from gdp.trust.right import Right
from proxy.check import command
from proxy.cli.delegate import app
from proxy.cli.proxy import app as proxy_app
from proxy.config.config import ProxyConfig

_HEAD = """\
identity: proxy
domain: {root: proxy/root.crt}
delegations: proxy/delegations
iface: proxy0
"""
_MAP = "  - {name: /map, type: nav_msgs/msg/OccupancyGrid, owner: owner.pub}\n"
_BOTH = ["--owner", "owner", "robot/proxy.yaml", "server/proxy.yaml"]


@pytest.fixture(autouse=True)
def _lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as leaving:
        main(["lab", "robot", "server"])
    assert not leaving.value.code
    Path("robot/proxy.yaml").write_text(f"{_HEAD}expose:\n{_MAP}")
    Path("server/proxy.yaml").write_text(f"{_HEAD}import:\n{_MAP}")


def _run(*words: str) -> list[str]:
    done = CliRunner().invoke(app, list(words))
    assert done.exit_code == 0, done.output
    return done.output.splitlines()


def _rights(host: str) -> list[frozenset[Right]]:
    return [each.rights for each in load_delegations(Path(host, "proxy/delegations"))]


def test_each_proxy_may_then_do_what_its_file_says() -> None:
    topic = "topic /map [nav_msgs/msg/OccupancyGrid]"
    assert _run(*_BOTH) == [f"robot/proxy.yaml: + publish {topic}", f"server/proxy.yaml: + read {topic}"]
    assert (_rights("robot"), _rights("server")) == ([frozenset({Right.PUBLISH})], [frozenset({Right.READ})])


def test_a_second_time_changes_nothing_unless_it_is_to_renew() -> None:
    _run(*_BOTH)
    (file,) = Path("robot/proxy/delegations").iterdir()
    before = file.read_bytes()
    assert all(": = " in line for line in _run(*_BOTH))
    assert file.read_bytes() == before
    assert all(": + " in line for line in _run("--renew", *_BOTH))
    assert file.read_bytes() != before


def test_a_right_that_comes_later_leaves_rights_and_epochs_of_before() -> None:
    rule = ProxyConfig.load(Path("robot/proxy.yaml")).expose[0]
    given = delegate(Path("owner"), Path("robot/proxy/node.card"), rule.overlay_metadata, [Right.READ], [0, 1, 2])
    save_delegation(Path("robot/proxy/delegations"), given)
    _run(*_BOTH)
    (now,) = load_delegations(Path("robot/proxy/delegations"))
    assert (now.rights, sorted(now.grants)) == (frozenset({Right.READ, Right.PUBLISH}), [0, 1, 2])


def test_an_expired_one_is_issued_again() -> None:
    rule = ProxyConfig.load(Path("robot/proxy.yaml")).expose[0]
    metadata, card = rule.overlay_metadata, Path("robot/proxy/node.card")
    old = delegate(Path("owner"), card, metadata, [Right.PUBLISH], days=1, unix_s=1e9)
    save_delegation(Path("robot/proxy/delegations"), old)
    assert "+ publish" in _run(*_BOTH)[0]


def test_the_private_keys_of_a_proxy_need_not_be_present() -> None:
    Path("server/proxy/node.key").unlink()
    Path("server/proxy/kem.key").unlink()
    assert "+ read" in _run(*_BOTH)[1]


def test_an_import_finds_what_another_machine_was_allowed_before() -> None:
    _run(*_BOTH)
    Path("robot/proxy.yaml").write_text(f"{_HEAD}expose:\n  - {{name: '/**', owner: owner.pub}}\n")
    Path("server/proxy.yaml").write_text(f"{_HEAD}import:\n  - {{name: '/*', owner: owner.pub}}\n")
    shutil.rmtree("server/proxy/delegations")
    Path("server/proxy/delegations").mkdir()
    assert "+ read topic /map" in _run(*_BOTH)[1]


def test_a_rule_of_which_nothing_is_known_is_said() -> None:
    Path("robot/proxy.yaml").write_text(f"{_HEAD}expose:\n  - {{name: '/**', owner: owner.pub}}\n")
    assert "robot/proxy.yaml: /**: nothing is known yet that it means; try --live" in _run(*_BOTH)


def test_an_owner_that_is_none_is_refused() -> None:
    done = CliRunner().invoke(app, ["--owner", "lab", "robot/proxy.yaml"])
    assert (done.exit_code, done.output.startswith("error: ")) == (2, True)


def test_an_owner_whom_no_rule_names_is_refused_with_those_that_they_name() -> None:
    with pytest.raises(SystemExit):
        main(["keygen", "owner", "other"])
    done = CliRunner().invoke(app, ["--owner", "other", "robot/proxy.yaml"])
    assert done.exit_code == 2
    assert "no rule of robot/proxy.yaml names this owner (other/owner.pub)" in done.output
    assert "they name robot/owner.pub" in done.output


@pytest.mark.parametrize("program", ["gdp delegate", "gdp delegate rules", "gdp-delegate"])
def test_all_three_spellings_do_the_same(program: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, *words = program.split()
    with pytest.raises(SystemExit) as leaving:
        (main if words else alias)([*words, *_BOTH])
    assert not leaving.value.code
    assert "robot/proxy.yaml: + publish topic /map" in capsys.readouterr().out


def test_delegations_of_a_node_are_listed_by_what_they_are_about(capsys: pytest.CaptureFixture[str]) -> None:
    _run(*_BOTH)
    with pytest.raises(SystemExit):
        alias(["ls", "robot/proxy"])
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("valid ")
    assert "publish  topic /map  [nav_msgs/msg/OccupancyGrid]" in line
    with pytest.raises(SystemExit):
        alias(["show", line.split()[-1], "--json"])
    said = json.loads(capsys.readouterr().out)
    assert (said["ros_name"], said["rights"], len(said["links"])) == ("/map", ["publish"], 1)


def test_an_expired_delegation_is_listed_as_such(capsys: pytest.CaptureFixture[str]) -> None:
    rule = ProxyConfig.load(Path("robot/proxy.yaml")).expose[0]
    old = delegate(
        Path("owner"), Path("robot/proxy/node.card"), rule.overlay_metadata, [Right.READ], days=1, unix_s=1e9
    )
    save_delegation(Path("robot/proxy/delegations"), old)
    with pytest.raises(SystemExit):
        alias(["ls", "robot/proxy"])
    assert capsys.readouterr().out.startswith("expired ")


def test_a_directory_without_delegations_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    for directory, code, said in (("robot/proxy", 0, "no delegation is in"), ("nowhere", 2, "no such directory")):
        with pytest.raises(SystemExit) as leaving:
            alias(["ls", directory])
        output = capsys.readouterr()
        assert (leaving.value.code or 0, said in output.out + output.err) == (code, True)


def test_the_check_names_imports_without_qos_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "read_graphs", lambda *_: [("ROS 2", frozenset())])
    more = "  - {name: /odom, type: nav_msgs/msg/Odometry, owner: owner.pub}\n"
    Path("server/proxy.yaml").write_text(f"{_HEAD}ros: {{endpoint: ros2, domain: 0}}\nimport:\n{_MAP}{more}")
    done = CliRunner().invoke(proxy_app, ["--config", "server/proxy.yaml", "--check"])
    assert "import /map, /odom: reliable and volatile until a publisher is known" in done.output
    done = CliRunner().invoke(proxy_app, ["--config", "server/proxy.yaml", "--check", "--json"])
    assert json.loads(done.output.splitlines()[-1])["unknown_qos"] == ["/map", "/odom"]


def test_a_recording_that_exists_is_refused_by_the_check_too() -> None:
    Path("there.mcap").touch()
    Path("server/proxy.yaml").write_text(f"{_HEAD}import:\n{_MAP}record: {{path: ../there.mcap}}\n")
    done = CliRunner().invoke(proxy_app, ["--config", "server/proxy.yaml", "--check"])
    assert done.exit_code == 2
    assert "there.mcap exists already; move or delete it, or change record.path" in done.output
