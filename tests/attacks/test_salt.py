"""Salt of a name, which no other user of the host may read."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import pytest

from fog.bootstrap.robot_config import add_rules, remove_rules
from fog.cluster import ExportedInterface
from fog.site import open_site
from gdp.config.drop_in import drop_in_directory
from gdp.errors import ConfigError
from gdp.metadata import Metadata
from proxy.config.config import ProxyConfig
from tests.gdp.cli.test_gdp import Run, gdp, keys

__all__ = ["gdp", "keys"]

PLAN = ExportedInterface("service", "/plan", "std_srvs/srv/Trigger")
NAME = "name --kind topic --name /a --json"
SALTED = Metadata({"kind": "topic", "name": "/a", "salt": "unguessable"}).name().to_text()


@pytest.fixture
def salt(gdp: Run) -> Path:
    path = Path("a.salt")
    path.write_text("unguessable\n")
    path.chmod(0o600)
    return path


@pytest.mark.parametrize("line", [NAME, "keygen node robot --role proxy --label robot"])
def test_a68_a_salt_as_an_argument_is_refused(gdp: Run, line: str) -> None:
    done = gdp(f"{line} --meta salt=unguessable")
    assert (done.code, done.out) == (2, "")
    assert "--salt-file" in done.err
    assert "unguessable" not in done.err


def test_a68_a_salt_comes_from_a_private_file(gdp: Run, salt: Path) -> None:
    said = json.loads(gdp(f"{NAME} --salt-file {salt}").out)
    assert said["name"] == SALTED
    assert said["metadata"]["salt"] == "(hidden)"
    salt.chmod(0o644)
    assert "chmod 600" in gdp(f"{NAME} --salt-file {salt}").err


def test_a68_a_salt_comes_from_the_environment(gdp: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GDP_SALT", "unguessable")
    assert json.loads(gdp(NAME).out)["name"] == SALTED
    monkeypatch.setenv("GDP_SALT", " ")
    assert "GDP_SALT: a salt is not empty" in gdp(NAME).err


def test_a68_a_salt_comes_from_standard_input(gdp: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("unguessable\n"))
    assert json.loads(gdp(f"{NAME} --salt-file -").out)["name"] == SALTED


def test_a68_a_delegation_is_for_the_salted_name(gdp: Run, keys: None, salt: Path) -> None:
    delegate = "delegate name --owner lab --card robot/node.card --right publish --kind topic --name /a --out d --json"
    plain = json.loads(gdp(f"{delegate}").out)["name"]
    assert json.loads(gdp(f"{delegate} --force --salt-file {salt}").out)["name"] != plain


def test_a68_a_rule_names_the_file_of_its_salt(tmp_path: Path) -> None:
    site = open_site(None, tmp_path / "state")
    path, salt = site.robots[0], tmp_path / "a.salt"
    salt.write_text("unguessable\n")
    salt.chmod(0o600)
    rule = "{name: /a, type: std_msgs/msg/Empty, owner: ../owner/owner.pub, %s}\n"
    before = path.read_text()
    path.write_text(f"{before}import:\n- " + rule % f"salt_file: {salt}")
    by_file = ProxyConfig.load(path).imports[0]
    path.write_text(f"{before}import:\n- " + rule % "metadata: {salt: unguessable}")
    written = ProxyConfig.load(path).imports[0]
    assert by_file.overlay_name_of("/a", by_file.type_name) == written.overlay_name_of("/a", written.type_name)
    assert "unguessable" not in repr(by_file)
    salt.chmod(0o644)
    path.write_text(f"{before}import:\n- " + rule % f"salt_file: {salt}")
    with pytest.raises(ConfigError, match="chmod 600"):
        ProxyConfig.load(path)


@pytest.mark.parametrize("mode", [0o600, 0o644])
@pytest.mark.parametrize("line", ["metadata: {salt: x}", 'metadata: {"salt": x}'])
def test_a68_fog_changes_neither_a_file_with_a_salt_nor_its_mode(tmp_path: Path, line: str, mode: int) -> None:
    site = open_site(None, tmp_path / "state")
    path = site.robots[0]
    with path.open("a") as file:
        file.write(f"import:\n- {{name: /a, type: std_msgs/msg/Empty, owner: ../owner/owner.pub, {line}}}\n")
    path.chmod(mode)
    before = path.read_bytes(), path.stat()
    add_rules(path, site.authority, "c", [PLAN], days=1.0)
    remove_rules(path, "c")
    assert (path.read_bytes(), path.stat()) == before


@pytest.mark.parametrize(("mode", "folder_mode"), [(0o600, 0o700), (0o644, 0o755)])
def test_a68_rules_of_fog_are_as_private_as_the_robots_file(tmp_path: Path, mode: int, folder_mode: int) -> None:
    site = open_site(None, tmp_path / "state")
    path = site.robots[0]
    path.chmod(mode)
    add_rules(path, site.authority, "c", [PLAN], days=1.0)
    (rules,) = drop_in_directory(path).iterdir()
    assert (rules.stat().st_mode & 0o777, rules.parent.stat().st_mode & 0o777) == (mode, folder_mode)


def test_a68_rules_of_fog_with_a_salt_are_private(tmp_path: Path) -> None:
    site = open_site(None, tmp_path / "state")
    path = site.robots[0]
    path.chmod(0o644)
    add_rules(path, site.authority, "c", [replace(PLAN, options={"metadata": {"salt": "x"}})], days=1.0)
    (rules,) = drop_in_directory(path).iterdir()
    assert rules.stat().st_mode & 0o777 == 0o600
