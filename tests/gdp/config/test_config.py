"""switch.yaml and rib.yaml, as people write them."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import pytest
from pydantic import ValidationError

from gdp.config.config import PortConfig, RibConfig, SwitchConfig
from gdp.config.schema import Section, first_fault, load
from gdp.config.yaml_source import ConfigFileError
from gdp.errors import ConfigError
from gdp.intervals import NEIGHBOUR
from gdp.limits import COST_AUTO, COST_DEFAULT, RIB_NAMES_PER_SENDER
from gdp.names import Name
from proxy.config.rule import Rule

SWITCH = """\
identity: id
domain: {root: root.crt, trusts: [other.crt]}
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "id").mkdir()
    for name in ("root.crt", "other.crt"):
        (tmp_path / name).write_text("a certificate")
    return tmp_path


def switch(place: Path, text: str) -> SwitchConfig:
    (place / "switch.yaml").write_text(text)
    return SwitchConfig.load(place / "switch.yaml")


def refusals(place: Path, text: str) -> list[str]:
    with pytest.raises(ConfigFileError) as caught:
        switch(place, text)
    return [line.removeprefix(f"{place}/") for line in str(caught.value).splitlines()]


def test_a_switch_needs_no_more_than_who_it_is(place: Path) -> None:
    config = switch(place, SWITCH)
    assert (config.ports, config.attach, config.data_plane, config.metrics) == ((), (), "auto", None)
    assert (config.hello_s, config.dead_s) == (NEIGHBOUR.refresh_s, NEIGHBOUR.lease_s)
    assert config.domain.transit is None


def test_paths_are_relative_to_the_file(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    config = switch(place, SWITCH)
    assert config.identity == place / "id"
    assert config.domain.root == place / "root.crt"
    assert config.domain.trusts == (place / "other.crt",)


def test_ports_carry_their_cost(place: Path) -> None:
    config = switch(place, SWITCH + "ports:\n  - iface: eth0\n  - {iface: eth1, cost: 100}\n")
    assert config.ports == (PortConfig(iface="eth0", cost=10), PortConfig(iface="eth1", cost=100))


def test_devices_of_the_command_line_are_added_once(place: Path) -> None:
    config = switch(place, SWITCH + "ports: [{iface: eth0, cost: 5}]\n").with_ifaces(["eth0", "eth1", "eth1"])
    assert [(port.iface, port.cost) for port in config.ports] == [("eth0", 5), ("eth1", 10)]


def test_the_cost_of_a_port_may_be_measured(place: Path) -> None:
    config = switch(place, SWITCH + "ports: [{iface: eth0, cost: auto}, {iface: eth1}]\n")
    assert [port.cost for port in config.ports] == [COST_AUTO, COST_DEFAULT]


def test_a_configuration_does_not_change(place: Path) -> None:
    config = switch(place, SWITCH)
    with pytest.raises(ValueError, match="frozen"):
        config.hello_s = 1.0


def test_every_error_of_a_file_is_listed_in_its_order(place: Path) -> None:
    text = "identity: nowhere\ndomain:\n  root: root.crt\n  trust: []\nports:\n  - {iface: a, cost: dear}\nspeed: 1\n"
    assert refusals(place, text) == [
        f"switch.yaml:1:11: identity: no such directory: {place}/nowhere",
        "switch.yaml:4:3: domain.trust: unknown key; expected one of root, trusts, transit, diagnostics",
        "switch.yaml:6:22: ports[0].cost: expected a whole number, not 'dear'",
        f"switch.yaml:7:1: speed: unknown key; expected one of {', '.join(SwitchConfig.model_fields)}",
    ]


def test_a_missing_key_is_reported_at_its_parent(place: Path) -> None:
    assert refusals(place, SWITCH + "metrics: {}\n") == ["switch.yaml:3:10: metrics.port: required, but not there"]


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("data_plane: xdp", "data_plane: expected 'auto', 'kernel', 'raw' or 'scapy', not 'xdp'"),
        ("ports: [{iface: a/b}]", "ports[0].iface: a device's name has 1 to 15 characters without '/', ':' or blanks"),
        ("ports: [{iface: a, cost: true}]", "ports[0].cost: expected a whole number, not True"),
        ("ports: [{iface: a, cost: 0}]", "ports[0].cost: expected greater than or equal to 1, not 0"),
        ("ports: [{iface: a}, {iface: a}]", "ports: a stands twice"),
        ("attach: [a, a]", "attach: a stands twice"),
        ("attach: [fourteen_chars]", "attach[0]: at most 13 characters, for the switch's end is fourteen_chars-s"),
        ("dead_s: 0.3", "dead_s: at least twice hello_s (0.25), so that one lost hello loses no neighbour"),
        ("lease_s: 0.5", "lease_s: expected greater than or equal to 1, not 0.5"),
        ("hello_s: .inf", "hello_s: expected a number, not '.inf'"),
        ("metrics: {port: 70000}", "metrics.port: expected less than or equal to 65535, not 70000"),
        ("attach: proxy", "attach: expected a list, not 'proxy'"),
    ],
)
def test_a_wrong_value_says_what_was_expected(place: Path, line: str, complaint: str) -> None:
    (refusal,) = refusals(place, f"{SWITCH}{line}\n")
    assert refusal.startswith("switch.yaml:3:")
    assert refusal.split(": ", 1)[1] == complaint


def test_an_attachment_is_not_a_port_as_well(place: Path) -> None:
    (refusal,) = refusals(place, SWITCH + "attach: [proxy]\nports: [{iface: proxy-s}]\n")
    assert refusal.endswith("attach: proxy is already the name of a port")


def test_a_missing_file_is_a_configuration_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: a readable file is expected: No such file"):
        SwitchConfig.load(tmp_path / "none.yaml")


def test_a_rib_names_the_tier_above(place: Path) -> None:
    upper = Name(bytes(range(32)))
    (place / "rib.yaml").write_text(f"{SWITCH}iface: rib\nupper: {upper.to_text()}\n")
    config = RibConfig.load(place / "rib.yaml")
    assert config.upper == (upper,)
    assert isinstance(config.upper[0], Name)


def test_a_rib_names_several_of_the_tier_above_and_its_peers(place: Path) -> None:
    one, two = Name(b"\xa1" * 32), Name(b"\xa2" * 32)
    names = f"[{one.to_text()}, {two.to_text()}]"
    (place / "rib.yaml").write_text(f"{SWITCH}iface: rib\nupper: {names}\npeers: {names}\n")
    config = RibConfig.load(place / "rib.yaml")
    assert (config.upper, config.peers) == ((one, two), (one, two))


@pytest.mark.parametrize("line", ["", "upper: null\n", "upper: ~\n"])
def test_the_top_tier_has_none_above(place: Path, line: str) -> None:
    (place / "rib.yaml").write_text(f"{SWITCH}iface: rib\n{line}")
    config = RibConfig.load(place / "rib.yaml")
    assert config.upper == ()
    assert not config.allow_unowned
    assert config.quotas.names_per_sender == RIB_NAMES_PER_SENDER


def test_a_name_of_digits_alone_is_read_as_text(place: Path) -> None:
    (place / "rib.yaml").write_text(f"{SWITCH}iface: rib\nupper: {'1' * 64}\n")
    assert RibConfig.load(place / "rib.yaml").upper == (Name(b"\x11" * 32),)


def test_a_shortened_name_is_refused(place: Path) -> None:
    (place / "rib.yaml").write_text(f"{SWITCH}iface: rib\nupper: 75e…0fc\n")
    with pytest.raises(ConfigFileError, match=r"rib\.yaml:4:8: upper: a name is written as 64 hex digits"):
        RibConfig.load(place / "rib.yaml")


class _Inner(Section):
    renamed: ClassVar[dict[str, str]] = {"credit": "limits.frames"}

    frames: int = 0


class _Outer(Section):
    renamed: ClassVar[dict[str, str]] = {"wait": "timeout_s"}

    timeout_s: int = 0
    inner: _Inner = _Inner()


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("wait: 1\n", "renamed.yaml:1:1: wait: this key is now called timeout_s"),
        ("inner:\n  credit: 1\n", "renamed.yaml:2:3: inner.credit: this key is now called limits.frames"),
    ],
)
def test_a_renamed_key_is_refused_with_its_new_name(tmp_path: Path, text: str, error: str) -> None:
    path = tmp_path / "renamed.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as refused:
        load(_Outer, path)
    assert error in str(refused.value)


def test_a_key_that_never_existed_is_still_refused_with_the_known_keys(tmp_path: Path) -> None:
    path = tmp_path / "renamed.yaml"
    path.write_text("speed: 1\n")
    with pytest.raises(ConfigError, match="unknown key; expected one of timeout_s, inner"):
        load(_Outer, path)


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"name": "nope"}, "name: expected a full ROS name, such as /camera/image"),
        ({"kind": "param", "name": "/x"}, "kind: Input should be 'topic', 'service', 'action' or 'node'"),
    ],
)
def test_a_fault_of_data_without_lines_has_its_key_and_no_word_of_the_validator(
    values: dict[str, str], fault: str
) -> None:
    with pytest.raises(ValidationError) as caught:
        Rule.model_validate({"kind": "topic", "owner": "key", **values})
    assert first_fault(caught.value).startswith(fault)
