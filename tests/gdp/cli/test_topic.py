"""``gdp topic`` without a running node: what a node's delegations hold, and the exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from gdp.crypto.certificates import Role
from gdp.management import control_client
from gdp.metadata import Metadata
from gdp.stores.issue import delegate, install_delegation, make_domain, make_node, make_owner
from gdp.stores.keyring import CARD
from gdp.trust.right import Right


@pytest.fixture
def viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a node that may read a topic, on a machine without running nodes."""
    monkeypatch.setattr(control_client, "lock_directories", lambda: (tmp_path / "locks",))
    monkeypatch.delenv("GDP_NODE", raising=False)
    make_domain(tmp_path / "domain", "lab")
    make_owner(tmp_path / "owner")
    node = tmp_path / "viewer"
    make_node(node, Role.PROXY, "viewer", tmp_path / "domain")
    (node / "delegations").mkdir(exist_ok=True)
    metadata = Metadata({"kind": "topic", "name": "/scan", "type": "sensor_msgs/msg/LaserScan"})
    install_delegation(node, delegate(tmp_path / "owner", node / CARD, metadata, [Right.READ]))
    return node


def run(*words: str) -> int:
    """Run ``gdp``; return its exit code."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    return int(ended.value.code or 0)


def test_the_names_that_a_node_holds_are_listed(viewer: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("topic", "list", "--all", "--json", "--node", str(viewer)) == 0
    row = json.loads(capsys.readouterr().out)
    assert (row["topic"], row["direction"], row["rights"]) == ("/scan", "held", "read")
    assert run("topic", "info", row["name"], "--node", str(viewer)) == 0


def test_a_machine_without_nodes_has_exit_code_3(viewer: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (("topic", "list"), ("top", "--once"), ("rib", "lookup", "ab" * 32)):
        assert run(*words) == 3
        assert "start one" in capsys.readouterr().err


def test_echo_without_the_right_has_exit_code_2_before_it_joins(
    viewer: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("topic", "echo", "/odom", "--type", "nav_msgs/msg/Odometry", "--node", str(viewer)) == 2
    error = capsys.readouterr().err
    assert "--right read --kind topic --name /odom --type nav_msgs/msg/Odometry" in error
    assert f"gdp delegate install odom.delegation --node {viewer}" in error
