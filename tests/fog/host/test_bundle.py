"""Bootstrap bundle of a machine as files."""

from __future__ import annotations

from pathlib import Path

import pytest

from fog.host.bundle import install, pack, unpack
from fog.machine import MachineBundle, Program
from gdp.errors import LocalError

BOOT = MachineBundle(
    {"switch/identity.key": b"secret", "proxy.yaml": b"iface: proxy0"},
    (
        Program("switch", ("{python}", "-m", "gdp.cli.switch"), " is up"),
        Program("node-1", ("true",), environment={"A": "b"}, restarts=False),
    ),
)


def test_a_packed_boot_unpacks_to_the_same() -> None:
    assert unpack(pack(BOOT)) == BOOT


def test_an_installed_boot_is_for_its_owner_alone(tmp_path: Path) -> None:
    home = tmp_path / "home"
    install(home, BOOT)
    assert {str(path.relative_to(home)): path.read_bytes() for path in home.rglob("*") if path.is_file()} == pack(BOOT)
    assert {path.stat().st_mode & 0o077 for path in [home, *home.rglob("*")]} == {0}


@pytest.mark.parametrize("path", ["/etc/passwd", "../outside", "a/../../b", "boot.json", ""])
def test_a_file_outside_of_the_folder_is_refused(path: str) -> None:
    with pytest.raises(LocalError, match="no place"):
        pack(MachineBundle({path: b""}, ()))


@pytest.mark.parametrize("names", [("a", "a"), ("a/b",), ("",)])
def test_programs_without_a_usable_name_of_their_own_are_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(LocalError, match="different names"):
        pack(MachineBundle({}, tuple(Program(name, ("true",)) for name in names)))


@pytest.mark.parametrize("content", [b"", b"[]", b'{"programs": [{"name": 1}]}', b'{"programs": 3}', b"\xff"])
def test_another_file_of_that_name_is_refused(content: bytes) -> None:
    with pytest.raises(LocalError, match=r"boot\.json"):
        unpack({"boot.json": content})


def test_a_folder_without_a_bundle_is_reported() -> None:
    with pytest.raises(LocalError, match=r"no boot\.json"):
        unpack({})
