"""``gdp lab``, as called by a person."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gdp.cli.gdp import main
from gdp.cli.switch import app as switch
from gdp.config.config import RibConfig, SwitchConfig
from gdp.crypto.certificates import Role
from gdp.nodes.membership import load_member
from gdp.session.settings import settings_of
from tests.pages import ROOT, blocks


@pytest.fixture(autouse=True)
def _in_an_empty_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def _lab(line: str) -> int:
    try:
        main(["lab", *line.split()])
    except SystemExit as leaving:
        return int(leaving.code or 0)
    return 0


def _switch(host: str) -> SwitchConfig:
    return SwitchConfig.load(Path(host, "switch.yaml"))


def test_two_machines_get_files_that_their_nodes_accept() -> None:
    assert _lab("robot server --iface eth0.7") == 0
    assert [(port.iface, port.cost) for port in _switch("server").ports] == [("eth0.7", 10)]
    assert (_switch("robot").attach, _switch("server").attach) == (("rib0", "proxy0"), ("proxy0",))
    rib = RibConfig.load(Path("robot/rib.yaml"))
    load_member(rib.identity, rib.domain, Role.RIB)
    load_member(_switch("server").identity, _switch("server").domain, Role.SWITCH)


def test_a_proxy_finds_a_place_for_delegations_and_the_owner_whose_rules_it_will_have() -> None:
    assert _lab("robot --owner boss") == 0
    assert Path("robot/proxy/delegations").is_dir()
    assert Path("robot/owner.pub").read_bytes() == Path("boss/owner.pub").read_bytes()


def test_a_machine_that_comes_later_is_of_the_same_domain_and_has_no_rib() -> None:
    assert _lab("robot") == 0
    assert _lab("arm") == 0
    assert Path("arm/switch/root.crt").read_bytes() == Path("robot/switch/root.crt").read_bytes()
    assert Path("arm/owner.pub").read_bytes() == Path("robot/owner.pub").read_bytes()
    assert not Path("arm/rib.yaml").exists()


def test_a_switch_finds_what_the_lab_left_and_takes_the_ports_of_its_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert _lab("robot --iface eth0") == 0
    found: list[SwitchConfig] = []
    monkeypatch.setattr("gdp.nodes.switch.run_switch", lambda settings, *_: found.append(settings))
    for line in ("--iface lan0", ""):
        assert CliRunner().invoke(switch, line.split()).exit_code == 0
    assert [[port.iface for port in each.ports] for each in found] == [["lan0"], ["eth0"]]
    assert {each.attach for each in found} == {("rib0", "proxy0")}


def test_the_command_that_a_switch_without_identity_names_makes_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(Path.cwd()))
    monkeypatch.setattr("gdp.cli.switch._machine_folders", list)
    monkeypatch.setattr("socket.gethostname", lambda: "robot")
    ended = CliRunner().invoke(switch, ["--iface", "eth0"])
    assert ended.exit_code == 2
    assert _lab(ended.output.rsplit("gdp lab ", 1)[1].strip()) == 0
    assert CliRunner().invoke(switch, ["--iface", "eth0", "--check"]).exit_code == 0


@pytest.mark.parametrize("line", ["server robot", "server server"])
def test_nothing_is_made_where_a_machine_is_there_already(line: str) -> None:
    Path("robot").mkdir()
    assert _lab(line) == 2
    assert [path.name for path in Path().iterdir()] == ["robot"]


def test_a_directory_that_is_no_domain_is_refused() -> None:
    Path("lab").mkdir()
    assert _lab("robot") == 2
    assert not Path("robot").exists()


def test_a_machine_with_a_leaf_gets_files_of_a_switch_that_carries_no_transit(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert _lab("desk") == 0
    assert _lab("robot --leaf") == 0
    switches = [_switch(host) for host in ("desk", "robot")]
    identities = [load_member(each.identity, each.domain, Role.SWITCH)[0] for each in switches]
    assert [each.role for each in identities] == [Role.SWITCH, Role.LEAF]
    capsys.readouterr()
    with pytest.raises(SystemExit):
        switch(["--config", "robot/switch.yaml", "--check"])
    assert capsys.readouterr().out.startswith(f"configuration good: leaf {identities[1].name.short}, 1 ports")


def test_programs_of_one_machine_get_nodes_next_to_one_switch_and_its_rib() -> None:
    assert _lab("--program robot server") == 0
    assert (_switch(".").ports, _switch(".").attach) == ((), ("rib0", "robot0", "server0"))
    rib = RibConfig.load(Path("rib.yaml"))
    load_member(rib.identity, rib.domain, Role.RIB)
    for program in ("robot", "server"):
        settings = settings_of(Path(program))
        assert settings.iface == f"{program}0"
        load_member(settings.identity, settings.domain, Role.PROXY)


@pytest.mark.parametrize("there", ["lab", "switch", "rib", "robot"])
def test_programs_need_a_directory_without_a_lab(there: str) -> None:
    Path(there).mkdir()
    assert _lab("--program robot") == 2
    assert [path.name for path in Path().iterdir()] == [there]


def test_the_pages_commands_make_two_domains_that_trust_each_other_and_name_the_rib_above() -> None:
    (block,) = (each for each in blocks(ROOT / "docs/how-to/ribs.md") if "--domain backbone" in each.text)
    here = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-ec", block.text], env={**os.environ, **here}, capture_output=True, text=True, timeout=120, check=True
    )
    hub = RibConfig.load(Path("hub/rib.yaml"))
    above, _ = load_member(hub.identity, hub.domain, Role.RIB)
    assert f"name         {above.name.to_text()}" in done.stdout.splitlines()
    with Path("robot/rib.yaml").open("a") as file:
        file.write(f"upper: {above.name.to_text()}\n")
    robot = RibConfig.load(Path("robot/rib.yaml"))
    assert robot.upper == (above.name,)
    for ours, other in (("robot", "hub"), ("hub", "robot")):
        for config in (_switch(ours), RibConfig.load(Path(ours, "rib.yaml"))):
            (trusted,) = config.domain.trusts
            assert trusted.read_bytes() == Path(other, "rib/root.crt").read_bytes()
