"""Drop-in rules of a proxy: the files that are read, their order, and errors that point into them."""

from __future__ import annotations

from pathlib import Path

import pytest

from fog.site import open_site
from gdp.config.drop_in import drop_in_directory
from gdp.errors import ConfigError
from proxy.config.config import ProxyConfig

RULE = "- {name: %s, type: std_msgs/msg/Empty, owner: %s}\n"
OWNER = "../owner/owner.pub"
OWNER_FROM_DROP_IN = "../../owner/owner.pub"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Configuration of a proxy without a rule, and an empty drop-in directory."""
    found = open_site(None, tmp_path / "state").robots[0]
    drop_in_directory(found).mkdir()
    return found


def drop(path: Path, name: str, text: str) -> Path:
    """Write a drop-in file."""
    file = drop_in_directory(path) / name
    file.write_text(text)
    return file


def test_rules_of_drop_ins_follow_those_of_the_file_in_the_order_of_names(path: Path) -> None:
    path.write_text(path.read_text() + "import:\n" + RULE % ("/own", OWNER))
    drop(path, "20-b.yaml", "import:\n" + RULE % ("/second", OWNER_FROM_DROP_IN))
    drop(path, "10-a.yaml", "import:\n" + RULE % ("/first", OWNER_FROM_DROP_IN))
    assert [rule.name for rule in ProxyConfig.load(path).imports] == ["/own", "/first", "/second"]


def test_a_drop_in_may_expose_and_import(path: Path) -> None:
    text = "expose:\n" + RULE % ("/out", OWNER_FROM_DROP_IN) + "import:\n" + RULE % ("/in", OWNER_FROM_DROP_IN)
    drop(path, "a.yaml", text)
    config = ProxyConfig.load(path)
    assert [rule.name for rule in (*config.expose, *config.imports)] == ["/out", "/in"]


@pytest.mark.parametrize("name", ["a.yml", "a.yaml.bak", ".a.yaml"])
def test_other_files_of_the_directory_are_not_read(path: Path, name: str) -> None:
    drop(path, name, "nonsense: 1\n")
    assert not ProxyConfig.load(path).imports


def test_a_proxy_needs_no_drop_in_directory(path: Path) -> None:
    drop_in_directory(path).rmdir()
    assert not ProxyConfig.load(path).imports


def test_a_key_that_belongs_into_the_main_file_is_refused_where_it_stands(path: Path) -> None:
    file = drop(path, "a.yaml", "import:\n" + RULE % ("/in", OWNER_FROM_DROP_IN) + "iface: eth0\n")
    with pytest.raises(ConfigError) as refused:
        ProxyConfig.load(path)
    assert str(refused.value) == f"{file}:3:1: iface: unknown key; expected one of expose, import, deny"


def test_an_error_in_a_drop_in_has_its_file_line_and_key(path: Path) -> None:
    file = drop(
        path, "a.yaml", "import:\n- {name: /in, typo: 1, type: std_msgs/msg/Empty, owner: ../../owner/owner.pub}\n"
    )
    with pytest.raises(ConfigError) as refused:
        ProxyConfig.load(path)
    assert str(refused.value).startswith(f"{file}:2:15: import[0].typo: unknown key")


def test_a_rule_that_conflicts_with_the_main_file_is_refused_where_it_stands(path: Path) -> None:
    path.write_text(path.read_text() + "import:\n" + RULE % ("/own", OWNER))
    drop(path, "a.yaml", "import:\n" + RULE % ("/other", OWNER_FROM_DROP_IN))
    file = drop(
        path, "b.yaml", "import:\n" + RULE % ("/fine", OWNER_FROM_DROP_IN) + RULE % ("/own", OWNER_FROM_DROP_IN)
    )
    with pytest.raises(ConfigError) as refused:
        ProxyConfig.load(path)
    assert str(refused.value).startswith(f"{file}:3:")
    assert "import[1]" in str(refused.value)


def test_an_error_of_the_main_file_stays_in_the_main_file(path: Path) -> None:
    drop(path, "a.yaml", "import:\n" + RULE % ("/in", OWNER_FROM_DROP_IN))
    path.write_text(path.read_text() + "expose:\n- {name: /x}\n")
    with pytest.raises(ConfigError) as refused:
        ProxyConfig.load(path)
    assert str(refused.value).startswith(f"{path}:")


def test_a_recording_may_have_all_its_rules_in_a_drop_in(path: Path, tmp_path: Path) -> None:
    path.write_text(path.read_text() + f"record: {{path: {tmp_path}/out.mcap}}\n")
    drop(path, "a.yaml", "import:\n" + RULE % ("/in", OWNER_FROM_DROP_IN))
    assert ProxyConfig.load(path).record is not None
