"""Settings of a session from a node's directory or a configuration file."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.crypto.certificates import Role
from gdp.errors import ConfigError, LocalError
from gdp.session.settings import settings_of
from gdp.stores.issue import make_domain, make_node


@pytest.fixture
def node(tmp_path: Path) -> Path:
    make_domain(tmp_path / "lab", "lab")
    make_node(tmp_path / "robot" / "proxy", Role.PROXY, "robot", tmp_path / "lab")
    return tmp_path / "robot" / "proxy"


def write(node: Path, text: str) -> Path:
    path = node.with_name("proxy.yaml")
    path.write_text(text)
    return path


PROXY = "identity: proxy\ndomain: {root: proxy/root.crt}\niface: eth7\ndelegations: proxy\nlease_s: 5.0\n"


def test_a_directory_alone_says_all_that_a_session_needs(node: Path) -> None:
    settings = settings_of(node)
    assert (settings.identity, settings.iface) == (node, "proxy0")
    assert settings.domain.root == node / "root.crt"
    assert settings.delegation_directory == node / "delegations"


def test_a_configuration_next_to_the_directory_goes_before_its_defaults(node: Path) -> None:
    write(node, PROXY)
    settings = settings_of(node)
    assert (settings.iface, settings.lease_s, settings.delegation_directory) == ("eth7", 5.0, node)


def test_a_configuration_of_another_node_next_to_the_directory_is_not_used(node: Path, tmp_path: Path) -> None:
    make_node(tmp_path / "robot" / "other", Role.PROXY, "other", tmp_path / "lab")
    write(node, PROXY.replace("identity: proxy", "identity: other"))
    assert settings_of(node).iface == "proxy0"


def test_the_rules_of_a_proxy_configuration_are_left_aside(node: Path) -> None:
    path = write(node, PROXY + "expose: [{name: /camera}]\nros: {endpoint: ros2}\n")
    assert settings_of(path).iface == "eth7"


def test_an_unknown_key_of_a_configuration_is_refused(node: Path) -> None:
    with pytest.raises(ConfigError, match="unknown key"):
        settings_of(write(node, PROXY + "ifaces: eth0\n"))


def test_an_option_goes_before_the_configuration(node: Path) -> None:
    settings = settings_of(write(node, PROXY), iface="eth9", lease_s=3, trusts=[node / "root.crt"])
    assert (settings.iface, settings.lease_s, settings.domain.trusts) == ("eth9", 3.0, (node / "root.crt",))


def test_an_option_out_of_bounds_is_refused_by_its_name(node: Path) -> None:
    with pytest.raises(LocalError, match="lease_s"):
        settings_of(node, lease_s=0.0)


def test_a_directory_without_keys_is_refused_with_the_commands_that_make_them(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match=r"gdp keygen node .* --role proxy"):
        settings_of(tmp_path)


def test_a_path_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match="no such directory or file"):
        settings_of(tmp_path / "nothing")
