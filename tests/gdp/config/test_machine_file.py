"""``machine.yaml``: each node reads its own section, with defaults, and errors name the line of the one file."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.config.config import RibConfig, SwitchConfig
from gdp.config.machine_file import read_sections
from gdp.config.store_config import HolderConfig, StoreConfig
from gdp.errors import ConfigError


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    for each in ("switch", "rib", "proxy"):
        (tmp_path / each).mkdir()
        (tmp_path / each / "root.crt").touch()
    (tmp_path / "machine.yaml").write_text("switch:\n  ports: [{iface: eth0}]\nrib:\nproxy: proxy.yaml\n")
    return tmp_path / "machine.yaml"


def test_a_section_has_the_defaults_of_the_machine(machine: Path) -> None:
    switch, rib = SwitchConfig.load(machine), RibConfig.load(machine)
    assert (switch.identity, switch.domain.root) == (machine.parent / "switch", machine.parent / "switch/root.crt")
    assert switch.attach == ("rib0", "proxy0")
    assert (rib.iface, rib.identity) == ("rib0", machine.parent / "rib")


def test_a_holder_is_a_section_that_the_switch_attaches(machine: Path) -> None:
    (machine.parent / "store").mkdir()
    (machine.parent / "store/root.crt").touch()
    machine.write_text("switch:\nstore: {holds: {folder: store, quota_gb: 2.5, peers: [store-b]}}\n")
    store = StoreConfig.load(machine)
    assert SwitchConfig.load(machine).attach == ("store0",)
    assert (store.iface, store.identity) == ("store0", machine.parent / "store")
    held = HolderConfig(folder=machine.parent / "store", quota_gb=2.5, peers=("store-b",))
    assert (store.holds, held.service, held.days) == (held, "store", None)
    assert read_sections(machine) == {"switch": machine, "store": machine}


def test_the_common_domain_is_that_of_each_section(machine: Path) -> None:
    machine.write_text("domain: {root: rib/root.crt}\nswitch: {}\nrib: {domain: {root: proxy/root.crt}}\n")
    assert SwitchConfig.load(machine).domain.root == machine.parent / "rib/root.crt"
    assert RibConfig.load(machine).domain.root == machine.parent / "proxy/root.crt"


def test_each_section_has_its_file_and_a_proxys_may_be_missing(machine: Path) -> None:
    assert read_sections(machine) == {"switch": machine, "rib": machine, "proxy": machine.parent / "proxy.yaml"}


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("switch: {prots: []}\n", ":1:10: prots: unknown key"),
        ("switch: {}\nswich: {}\n", ":2:1: swich: unknown key"),
        ("switch: 7\n", ":1:9: switch: expected a mapping"),
        ("switch: other.yaml\n", ":1:9: switch: this node's configuration is in other.yaml"),
        ("domain: {root: none.crt}\nswitch: {}\n", ":1:16: domain.root: no such file"),
        ("switch: {attach: 3}\n", ":1:18: attach: expected a list"),
    ],
)
def test_an_error_names_the_place_in_the_one_file(machine: Path, text: str, error: str) -> None:
    machine.write_text(text)
    with pytest.raises(ConfigError) as raised:
        SwitchConfig.load(machine)
    assert f"{machine}{error}" in str(raised.value)


@pytest.mark.parametrize(
    ("holds", "error"),
    [
        ("{}", ":1:16: holds.folder: required"),
        ("{folder: none}", ":1:25: holds.folder: no such directory"),
        ("{folder: rib, quota_gb: 0}", "holds.quota_gb: "),
        ("{folder: rib, quota: 1}", ":1:30: holds.quota: unknown key"),
    ],
)
def test_an_error_of_a_holder_names_its_place(machine: Path, holds: str, error: str) -> None:
    machine.write_text(f"store: {{holds: {holds}, identity: rib}}\n")
    with pytest.raises(ConfigError) as raised:
        StoreConfig.load(machine)
    assert error in str(raised.value)


@pytest.mark.parametrize("text", ["identity: switch\n", "[]\n", "switch: other.yaml\n"])
def test_a_file_that_is_no_machines_is_refused(machine: Path, text: str) -> None:
    machine.write_text(text)
    with pytest.raises(ConfigError):
        read_sections(machine)
