"""``gdp reload``, ``status`` and ``drain`` on real nodes that have dropped their privileges."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from gdp.management.control_client import find_control_socket
from netns_tests.spaces import Space
from netns_tests.test_rights import PATIENCE_S, Commands, Node, commands
from tests.pages import ROOT
from tests.waiting import until

__all__ = ["commands"]  # a fixture

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about control sockets, no lease matters"),
]


class Nodes:
    """Running switch, RIB and recording proxy."""

    def __init__(self, commands: Commands) -> None:
        self.commands = commands
        self.switch = self._start("gdp.cli.switch", "switch", "--data-plane", "raw")
        self.rib = self._start("gdp.cli.rib", "rib", "--await-iface", "30")
        self.proxy = self._start("proxy.cli.proxy", "proxy", "--await-iface", "30")

    def gdp(self, *words: str) -> tuple[int, str]:
        """Run ``gdp`` in the folder of the nodes; return its exit code and its whole output."""
        argv = [sys.executable, "-m", "gdp.cli.gdp", *words]
        ended = subprocess.run(
            argv,
            cwd=self.commands.home,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        return ended.returncode, ended.stdout

    def socket(self, name: str) -> Path:
        """Return the control socket of a node."""
        return find_control_socket(self.commands.home / name)

    def _start(self, module: str, name: str, *more: str) -> Node:
        node = self.commands.start(module, name, *more)
        node.until('"ready"')
        return node


@pytest.fixture
def nodes(space: Space, commands: Commands) -> Nodes:
    """Running nodes of one domain."""
    del space
    return Nodes(commands)


def reload_reads_what_sighup_reads(nodes: Nodes) -> None:
    (nodes.commands.home / "revoked" / "x").write_bytes(b"no statement")
    assert nodes.gdp("reload", "switch")[0] == 0
    nodes.switch.until("revocation not taken")
    assert nodes.gdp("reload", "rib")[0] == 0


def a_refused_reload_says_why(nodes: Nodes) -> None:
    for file in (nodes.commands.home / "proxy" / "delegations").iterdir():
        file.unlink()
    code, text = nodes.gdp("reload", "proxy")
    assert code == 1
    assert "no delegation for" in text


def test_running_nodes_show_their_status_and_links_and_reload_what_they_accept(nodes: Nodes) -> None:
    def is_measured() -> bool:
        shown = json.loads(nodes.gdp("status", "switch", "--json")[1])
        return bool(len(shown["link_quality"]) == shown["neighbours"] > 0)

    until(is_measured, "the switch has measured its links")
    for name in ("rib", "proxy", "switch"):
        code, text = nodes.gdp("status", name, "--json")
        shown = json.loads(text)
        assert code == 0
        assert (shown["state"], shown["role"]) == ("running", name)
        assert shown["counters"]["frames"]["in"] > 0
    assert len(shown["link_quality"]) == shown["neighbours"] > 0
    assert {key for row in shown["link_quality"] for key in row} == {
        "port", "neighbour", "rtt_ms", "rtt_var_ms", "loss_in", "loss_out", "cost",
    }  # fmt: skip
    assert {row["cost"] for row in shown["link_quality"]} == {10}
    reload_reads_what_sighup_reads(nodes)
    a_refused_reload_says_why(nodes)


def test_nodes_that_drain_end_and_leave_no_socket(nodes: Nodes) -> None:
    sockets = [nodes.socket(name) for name in ("proxy", "rib", "switch")]
    assert all(path.stat().st_mode & 0o777 == 0o600 for path in sockets)
    for name, node in (("proxy", nodes.proxy), ("rib", nodes.rib), ("switch", nodes.switch)):
        code, text = nodes.gdp("drain", name, "--json")
        assert (code, json.loads(text)) == (0, {"state": "drained", "complete": True})
        assert node.process.wait(PATIENCE_S) == 0
    assert not any(path.exists() for path in sockets)
    assert {path.name for path in (nodes.commands.home / "kept").iterdir()} == {"received.mcap", "routes"}


def test_the_socket_of_a_killed_node_is_replaced(nodes: Nodes) -> None:
    nodes.proxy.process.send_signal(signal.SIGKILL)
    nodes.proxy.process.wait(PATIENCE_S)
    assert nodes.socket("proxy").exists()
    code, text = nodes.gdp("status", "proxy")
    assert (code, "no process serves this control socket" in text) == (3, True)
    (nodes.commands.home / "kept" / "received.mcap").unlink(missing_ok=True)
    again = nodes.commands.start("proxy.cli.proxy", "proxy")
    again.until('"ready"')
    assert nodes.gdp("status", "proxy")[0] == 0


def measured_links(page: ClientConnection) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the newest structure and figures of a page, once the figures show round trips and traffic."""
    shown: dict[str, dict[str, Any]] = {}

    def is_measured() -> bool:
        message = json.loads(page.recv(PATIENCE_S))
        shown[message["kind"]] = message
        links = message.get("links", ()) if message["kind"] == "figures" else ()
        return all(rtt_ms is not None for _, _, rtt_ms, _ in links) and any(there + back for there, back, _, _ in links)

    until(is_measured, "the round trips of a live view", PATIENCE_S)
    return shown["structure"], shown["figures"]


def test_the_live_view_shows_running_nodes_that_dropped_their_rights(space: Space, nodes: Nodes) -> None:
    space.ip("set", "lo", "up")
    home = nodes.commands.home
    words = [word for name in ("switch", "rib", "proxy") for word in ("--node", str(home / name))]
    command = [sys.executable, "-m", "gdp.cli.gdp", "dashboard", "--json", *words]
    with subprocess.Popen(
        command, cwd=home, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, text=True
    ) as view:
        try:
            assert view.stdout is not None
            ready = json.loads(view.stdout.readline())
            with connect(ready["url"].replace("http", "ws") + "live") as page:
                structure, figures = measured_links(page)
        finally:
            view.terminate()
        assert view.wait(PATIENCE_S) == 0
    assert sorted(role for _, role, _, _, is_near in structure["nodes"] if is_near) == ["proxy", "rib", "switch"]
    assert len(structure["links"]) == 2
    assert all(rtt_ms is not None for _, _, rtt_ms, _ in figures["links"])
    assert any(there + back > 0 for there, back, _, _ in figures["links"])
    assert structure["names"]
