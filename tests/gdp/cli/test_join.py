"""``gdp domain create``, ``token``, ``ls``, ``remove`` and ``gdp join``, without the programs that they start."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from gdp.cli import domain_machine
from gdp.cli.gdp import main
from gdp.config.config import RibConfig, SwitchConfig
from gdp.config.relay_config import RelayConfig
from gdp.enrolment import service_units
from gdp.enrolment.addresses import default_directory, duration_s, is_private, server_text
from gdp.enrolment.member_files import MemberFiles
from gdp.enrolment.programs import Machine, MachineProgram, programs_of
from gdp.enrolment.units import install_units, remove_units
from gdp.errors import LocalError
from gdp.trust.join_token import JoinToken
from proxy.config.config import ProxyConfig
from tests.gdp.enrolment.lab import Lab, running_lab


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    with running_lab(tmp_path_factory.mktemp("commands")) as made:
        yield made


def _run(*words: str, token: str = "") -> int:
    """Return the exit code of ``gdp``, which gets a token by GDP_TOKEN."""
    with pytest.MonkeyPatch.context() as patch:
        if token:
            patch.setenv("GDP_TOKEN", token)
        with pytest.raises(SystemExit) as ended:
            main(words)
    return int(ended.value.code or 0)


def _made(lab: Lab, capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert _run("domain", "token", "lab", "--directory", str(lab.files.directory), *words) == 0
    line = capsys.readouterr().out
    assert line.startswith("gdp1")
    return line.strip()


def test_create_prints_one_token_that_a_person_copies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("domain", "create", "lab", "--public", "203.0.113.7", "--directory", str(tmp_path / "lab"), "--no-start")
    assert _run(*words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1
    assert JoinToken.from_text(lines[0]).servers == (
        "203.0.113.7:51820",
        "203.0.113.7:443",
    )


def test_create_prints_a_token_for_each_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("domain", "create", "lab", "--public", "203.0.113.7", "--directory", str(tmp_path / "lab"), "--no-start")
    assert _run(*words, "--tokens", "2") == 0
    lines = capsys.readouterr().out.splitlines()
    secrets = {JoinToken.from_text(each).secret for each in lines}
    assert len(lines) == len(secrets) == 2


def test_what_create_writes_is_a_good_configuration_of_each_node(tmp_path: Path) -> None:
    words = ("domain", "create", "lab", "--public", "[2001:db8::1]:443", "--directory", str(tmp_path / "lab"))
    assert _run(*words, "--no-start") == 0
    switch = SwitchConfig.load(tmp_path / "lab/switch.yaml")
    assert switch.links is not None
    assert switch.links.public == ("[2001:db8::1]:443",)
    assert RibConfig.load(tmp_path / "lab/rib.yaml").iface == "rib0"
    assert ProxyConfig.load(tmp_path / "lab/proxy.yaml").iface == "proxy0"
    programs = [each.name for each in programs_of(MemberFiles.load(tmp_path / "lab"))]
    assert programs[:4] == ["switch", "relay", "rib", "enrolment"]
    relay = RelayConfig.load(tmp_path / "lab/relay.yaml")
    assert relay.server is not None
    assert relay.server.port == 443
    assert programs[-1] == "agent"


def test_create_does_not_overwrite_a_domain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("domain", "create", "lab", "--public", "203.0.113.7", "--directory", str(tmp_path / "lab"), "--no-start")
    assert _run(*words) == 0
    key = (tmp_path / "lab/domain/root.key").read_bytes()
    assert _run(*words) == 2
    assert "is there already; gdp domain token makes a token" in capsys.readouterr().err
    assert (tmp_path / "lab/domain/root.key").read_bytes() == key
    assert [each.name for each in tmp_path.iterdir()] == ["lab"]


def test_create_warns_of_a_private_address(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(domain_machine, "default_addresses", lambda: ["10.0.0.5"])
    assert _run("domain", "create", "lab", "--directory", str(tmp_path / "lab"), "--no-start") == 0
    assert "10.0.0.5 is a private address: machines elsewhere need a --public HOST" in capsys.readouterr().err


def test_create_without_a_default_route_asks_for_an_address(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(domain_machine, "default_addresses", lambda: [])
    assert _run("domain", "create", "lab", "--directory", str(tmp_path / "lab"), "--no-start") == 2
    assert "state --public HOST" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["", "../lab", "-x", "a b"])
def test_create_refuses_a_name_that_is_no_file_name(name: str, tmp_path: Path) -> None:
    assert _run("domain", "create", "--directory", str(tmp_path / "lab"), "--no-start", "--", name) == 2


def test_join_writes_a_good_configuration_of_each_node(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    token, home = _made(lab, capsys), lab.folder / "robot-1"
    words = ("join", "--label", "robot-1", "--directory", str(home), "--no-start", "--json")
    assert _run(*words, "--uplink", "wlan0", "--uplink", "wwan0", token=token) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["domain"], result["label"], result["role"]) == ("lab", "robot-1", "robot")
    assert not (home / "relay.yaml").exists()  # this domain's border has no relay
    switch = SwitchConfig.load(home / "switch.yaml")
    assert switch.links is not None
    assert switch.links.uplinks == ("wlan0", "wwan0")
    assert list((home / "peers").glob("*.endpoints"))
    assert ProxyConfig.load(home / "proxy.yaml").identity == home / "proxy"


@pytest.mark.parametrize(("role", "programs"), [("robot", ["switch", "proxy", "agent"]), ("leaf", ["switch", "agent"])])
def test_the_role_of_a_token_decides_what_runs(
    role: str, programs: list[str], lab: Lab, capsys: pytest.CaptureFixture[str]
) -> None:
    token, home = _made(lab, capsys, "--role", role, "--label", f"by-{role}"), lab.folder / f"by-{role}"
    assert _run("join", "--label", f"by-{role}", "--directory", str(home), "--no-start", token=token) == 0
    found = [each.name for each in programs_of(MemberFiles.load(home))]
    assert [each for each in found if each != "proxy"] == [each for each in programs if each != "proxy"]
    assert (home / "proxy.yaml").exists() is ("proxy" in programs)


def test_a_token_that_was_typed_wrong_ends_with_exit_code_2(capsys: pytest.CaptureFixture[str], lab: Lab) -> None:
    token = _made(lab, capsys)
    wrong = token[:30] + ("a" if token[30] != "a" else "b") + token[31:]
    assert _run("join", token=wrong) == 2
    assert "the token was typed or copied wrong" in capsys.readouterr().err


def test_a_refused_token_ends_with_exit_code_2_and_leaves_nothing(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    token = _made(lab, capsys)
    for number, code in ((1, 0), (2, 2)):
        home = lab.folder / f"user-{number}"
        words = ("join", "--label", f"user-{number}", "--directory", str(home), "--no-start")
        assert _run(*words, token=token) == code
        assert home.exists() is (code == 0)
    assert "this token was used already by 'user-1'" in capsys.readouterr().err


def test_ls_and_remove_show_what_became_of_a_machine(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    lab.join("visitor")
    where = ("--directory", str(lab.files.directory))
    assert _run("domain", "ls", "lab", *where) == 0
    assert "visitor" in capsys.readouterr().out
    assert _run("domain", "remove", "lab", "visitor", *where) == 0
    assert _run("domain", "ls", "lab", *where) == 0
    assert "visitor" not in capsys.readouterr().out.split("removed")[-1].partition("border")[2]
    assert _run("domain", "ls", "lab", *where, "--all", "--json") == 0
    rows = {each["label"]: each for each in json.loads(capsys.readouterr().out)}
    assert rows["visitor"]["state"] == "revoked"
    assert rows["visitor"]["revoked"]
    assert rows["border"]["revoked"] is None


@pytest.mark.parametrize("words", [("--role", "king"), ("--valid", "soon"), ("--valid", "0h")])
def test_token_refuses_what_it_does_not_know(words: tuple[str, str], lab: Lab) -> None:
    assert _run("domain", "token", "lab", "--directory", str(lab.files.directory), *words) == 2


def test_a_directory_without_a_domain_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run("domain", "ls", "lab", "--directory", str(tmp_path)) == 2
    assert "create the domain with gdp domain create" in capsys.readouterr().err
    assert _run("up", str(tmp_path)) == 2
    assert "run gdp join or gdp domain create" in capsys.readouterr().err


def test_units_start_the_switch_first_and_quote_their_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_units, "_PRIVATE_TMP", ())
    programs = (
        MachineProgram(name="switch", title="A switch", argv=("/bin/true", "a b%$")),
        MachineProgram(name="proxy", title="A proxy", argv=("/bin/true",), environment=(("ROS_DISTRO", "jazzy"),)),
    )
    directory = tmp_path / "my lab"
    directory.mkdir()
    units = service_units.service_texts(Machine(directory=directory, programs=programs, is_member=True))
    assert list(units) == ["gdp-my-lab-switch.service", "gdp-my-lab-proxy.service"]
    assert 'ExecStart=/bin/true "a b%%$$"\n' in units["gdp-my-lab-switch.service"]
    assert "After=network-online.target gdp-my-lab-switch.service\n" in units["gdp-my-lab-proxy.service"]
    assert "Environment=ROS_DISTRO=jazzy\n" in units["gdp-my-lab-proxy.service"]


def test_units_are_written_started_and_removed(tmp_path: Path) -> None:
    called = list[list[str]]()
    units = {"gdp-x-switch.service": "[Unit]\n"}
    install_units(units, tmp_path, lambda words: called.append(list(words)))
    assert (tmp_path / "gdp-x-switch.service").read_text() == "[Unit]\n"
    remove_units(list(units), tmp_path, lambda words: called.append(list(words)))
    assert not list(tmp_path.iterdir())
    assert [words[0] for words in called] == ["daemon-reload", "enable", "disable", "daemon-reload"]


@pytest.mark.parametrize(
    ("text", "server"),
    [
        ("203.0.113.7", "203.0.113.7:51820"),
        ("203.0.113.7:443", "203.0.113.7:443"),
        ("2001:db8::1", "[2001:db8::1]:51820"),
        ("[2001:db8::1]:443", "[2001:db8::1]:443"),
        ("lab.example.org", "lab.example.org:51820"),
    ],
)
def test_a_public_address_may_leave_the_port_out(text: str, server: str) -> None:
    assert server_text(text, 51_820) == server


@pytest.mark.parametrize("text", ["", "a b", "host:", "host:port", "häuser"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(LocalError):
        server_text(text, 51_820)


@pytest.mark.parametrize(("text", "seconds"), [("90s", 90), ("30m", 1_800), ("1h", 3_600), ("7d", 604_800)])
def test_durations_have_a_unit(text: str, seconds: float) -> None:
    assert duration_s(text) == seconds


def test_private_addresses_are_known() -> None:
    assert [is_private(each) for each in ("10.0.0.1", "192.168.1.1", "fd00::1", "9.9.9.9")] == [True, True, True, False]


def test_the_default_directory_depends_on_the_user() -> None:
    assert default_directory("lab", is_root=True, state_home="") == Path("/var/lib/gdp/lab")
    assert default_directory("lab", is_root=False, state_home="/state") == Path("/state/gdp/lab")
