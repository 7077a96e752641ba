"""``gdp reload``, ``status`` and ``drain`` on real nodes that have dropped their privileges."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from gdp.management.control_client import find_control_socket
from lab.machine import GDP, LabMachine
from lab.namespaces import Space
from lab.process import LabProcess, until
from netns_tests.test_rights import configured, start_all

PATIENCE_S = 60.0

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about control sockets, no lease matters"),
]


Running = dict[str, LabProcess]


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LabMachine]:
    with Space() as space, LabMachine(tmp_path_factory.mktemp("nodes")) as machine:
        space.ip("link", "set", "lo", "up")
        yield configured(space, machine)


@pytest.fixture(scope="module")
def running(nodes: LabMachine) -> Running:
    """Running switch, RIB and recording proxy of one domain; the last test ends them."""
    return dict(zip(("switch", "rib", "proxy"), start_all(nodes), strict=True))


def gdp(nodes: LabMachine, *words: str) -> tuple[int, str]:
    """Run ``gdp`` in the folder of the nodes; return its exit code and its whole output."""
    done = nodes.run(*GDP, *words)
    return done.returncode, done.stdout + done.stderr


def socket(nodes: LabMachine, name: str) -> Path:
    """Return the control socket of a node."""
    return find_control_socket(nodes.folder / name)


def reload_reads_what_sighup_reads(nodes: LabMachine, switch: LabProcess) -> None:
    (nodes.folder / "revoked" / "x").write_bytes(b"no statement")
    assert gdp(nodes, "reload", "switch")[0] == 0
    switch.until_logged("revocation not taken")
    assert gdp(nodes, "reload", "rib")[0] == 0


def a_refused_reload_says_why(nodes: LabMachine) -> None:
    for file in (nodes.folder / "proxy" / "delegations").iterdir():
        file.unlink()
    code, text = gdp(nodes, "reload", "proxy")
    assert code == 1
    assert "no delegation for" in text


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


def test_the_live_view_shows_running_nodes_that_dropped_their_rights(nodes: LabMachine, running: Running) -> None:
    words = [word for name in running for word in ("--node", name)]
    view = nodes.launch([*GDP, "dashboard", "--json", *words])
    url = str(view.read(PATIENCE_S)["url"])
    with connect(url.replace("http", "ws") + "live") as page:
        structure, figures = measured_links(page)
    view.finish(signal.SIGTERM)
    assert view.code == 0
    assert sorted(role for _, role, _, _, is_near in structure["nodes"] if is_near) == ["proxy", "rib", "switch"]
    assert len(structure["links"]) == 2
    assert all(rtt_ms is not None for _, _, rtt_ms, _ in figures["links"])
    assert any(there + back > 0 for there, back, _, _ in figures["links"])
    assert structure["names"]


def test_the_socket_of_a_killed_node_is_replaced(nodes: LabMachine, running: Running) -> None:
    nodes.kill(running["proxy"])
    assert socket(nodes, "proxy").exists()
    code, text = gdp(nodes, "status", "proxy")
    assert (code, "no process serves this control socket" in text) == (3, True)
    (nodes.folder / "kept" / "received.mcap").unlink(missing_ok=True)
    running["proxy"] = nodes.start("proxy", "proxy")
    assert gdp(nodes, "status", "proxy")[0] == 0


def test_running_nodes_show_their_status_and_links_and_reload_what_they_accept(
    nodes: LabMachine, running: Running
) -> None:
    def is_measured() -> bool:
        shown = json.loads(gdp(nodes, "status", "switch", "--json")[1])
        return bool(len(shown["link_quality"]) == shown["neighbours"] > 0)

    until(is_measured, "the switch has measured its links")
    for name in ("rib", "proxy", "switch"):
        code, text = gdp(nodes, "status", name, "--json")
        shown = json.loads(text)
        assert code == 0
        assert (shown["state"], shown["role"]) == ("running", name)
        assert shown["counters"]["frames"]["in"] > 0
    assert len(shown["link_quality"]) == shown["neighbours"] > 0
    assert {key for row in shown["link_quality"] for key in row} == {
        "port", "neighbour", "rtt_ms", "rtt_var_ms", "loss_in", "loss_out", "cost",
    }  # fmt: skip
    assert {row["cost"] for row in shown["link_quality"]} == {10}
    reload_reads_what_sighup_reads(nodes, running["switch"])
    a_refused_reload_says_why(nodes)


def test_nodes_that_drain_end_and_leave_no_socket(nodes: LabMachine, running: Running) -> None:
    sockets = [socket(nodes, name) for name in ("proxy", "rib", "switch")]
    assert all(path.stat().st_mode & 0o777 == 0o600 for path in sockets)
    for name, node in reversed(running.items()):
        code, text = gdp(nodes, "drain", name, "--json")
        assert (code, json.loads(text)) == (0, {"state": "drained", "complete": True})
        node.output()
    assert not any(path.exists() for path in sockets)
    kept = {path.name for path in (nodes.folder / "kept").iterdir()}
    assert {each for each in kept if "-killed" not in each} == {"received.mcap", "routes"}
