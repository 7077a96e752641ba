"""Server of the live view: who gets the page, and what it may load."""

from __future__ import annotations

import asyncio
import http.client
import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from gdp.errors import LocalError
from gdp.management.control_client import control_path
from gdp.management.control_socket import CONTROL_SOCKET
from gdp.names import Name
from gdp.state.control_protocol import Response, encode_response
from gdp_extensions.dashboard.poller import Poller, found_sockets
from gdp_extensions.dashboard.server import DashboardServer
from tests.gdp_extensions.dashboard.synthetic_nodes import SyntheticNetwork, serve_network


@contextmanager
def running(nodes: list[Path], states: tuple[Path, ...] = (), poll_s: float = 0.05) -> Iterator[DashboardServer]:
    """Serve a live view in a thread."""
    made: list[DashboardServer] = []
    ready, loop = threading.Event(), asyncio.new_event_loop()
    stop = asyncio.Event()

    async def serve() -> None:
        made.append(DashboardServer(Poller(nodes, states), poll_s=poll_s))
        await made[0].run_until(ready.set, stop)

    thread = threading.Thread(target=lambda: loop.run_until_complete(serve()))
    thread.start()
    assert ready.wait(10)
    try:
        yield made[0]
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join()
        loop.close()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[DashboardServer]:
    """A live view of a small ring."""
    with serve_network(SyntheticNetwork(5, 4, 24, is_ring=True), tmp_path) as nodes, running(nodes) as made:
        yield made


def get(server: DashboardServer, path: str, host: str | None = None) -> http.client.HTTPResponse:
    """Return the response to a GET."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.request("GET", path, headers={"Host": host or f"127.0.0.1:{server.port}"})
    response = connection.getresponse()
    response.read()
    connection.close()
    return response


def test_the_page_may_load_from_its_own_origin_alone(server: DashboardServer) -> None:
    response = get(server, f"/{server.url.split('/')[3]}/")
    policy = response.headers["Content-Security-Policy"]
    assert response.status == 200
    assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self';")
    assert (response.headers["Referrer-Policy"], response.headers["Cache-Control"]) == ("no-referrer", "no-store")


@pytest.mark.parametrize("path", ["/", "/index.html", "/wrong/", "/wrong/live", "/main.js"])
def test_nothing_is_served_without_the_token(server: DashboardServer, path: str) -> None:
    assert get(server, path).status == 404


@pytest.mark.parametrize("name", ["../server.py", "%2e%2e/server.py", "nothing.js"])
def test_only_the_files_of_the_page_are_served(server: DashboardServer, name: str) -> None:
    assert get(server, f"/{server.url.split('/')[3]}/{name}").status == 404


def test_another_host_name_that_points_here_is_refused(server: DashboardServer) -> None:
    assert get(server, f"/{server.url.split('/')[3]}/", host="evil.example").status == 403


def test_a_page_of_another_origin_is_refused(server: DashboardServer) -> None:
    with pytest.raises(InvalidStatus, match="403"):
        connect(server.url.replace("http", "ws") + "live", origin=Origin("http://evil.example"))


def test_a_page_gets_the_structure_then_figures_and_what_it_asks_for(server: DashboardServer) -> None:
    with connect(server.url.replace("http", "ws") + "live") as page:
        structure: Any = json.loads(page.recv(10))
        assert (structure["kind"], len(structure["nodes"]), len(structure["names"])) == ("structure", 11, 25)
        assert json.loads(page.recv(10))["kind"] == "figures"
        plan = next(row[0] for row in structure["names"] if row[1] == "/plan")
        page.send(json.dumps({"name": plan, "history": ["total messages"]}))
        kinds: dict[str, Any] = {}
        while not {"name", "history"} <= kinds.keys():
            message = json.loads(page.recv(10))
            kinds[message["kind"]] = message
        assert len(kinds["name"]["trees"]) == 4
        page.send("no json")
        page.send("[]")
        assert json.loads(page.recv(10))["kind"] in ("figures", "name")


def test_a_node_that_ends_leaves_the_picture(tmp_path: Path) -> None:
    network = SyntheticNetwork(5, 4, 24, is_ring=True)
    with serve_network(network, tmp_path) as nodes, running(nodes) as server:
        with connect(server.url.replace("http", "ws") + "live") as page:
            network.stopped.add("robot2")
            while True:
                message: Any = json.loads(page.recv(10))
                if message["kind"] == "figures" and any(each["is_bad"] for each in message["events"]):
                    break
        assert server.scene.graph.nodes


def test_a_state_of_fog_without_a_supervisor_shows_nothing(tmp_path: Path) -> None:
    with running([], (tmp_path,)) as server:
        assert server.scene.graph.nodes == {}


def test_all_nodes_of_this_host_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FOG_STATE", str(tmp_path))
    monkeypatch.setattr("gdp.management.control_client.lock_directories", lambda: (tmp_path,))
    (tmp_path / f"{control_path(Name(bytes(32))).name}").touch()
    (tmp_path / "control.sock").touch()
    assert {each.name for each in found_sockets()} == {f"{'00' * 32}.sock", "control.sock"}


def test_a_directory_of_no_node_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match="expected the directory of a node"):
        found_sockets([tmp_path])


def test_a_node_that_hangs_or_refuses_does_not_hide_the_others(tmp_path: Path) -> None:
    (tmp_path / "hung").mkdir()
    (tmp_path / "old").mkdir()
    with socket.socket(socket.AF_UNIX) as hung, socket.socket(socket.AF_UNIX) as old:
        hung.bind(str(tmp_path / "hung" / CONTROL_SOCKET))
        old.bind(str(tmp_path / "old" / CONTROL_SOCKET))
        hung.listen()
        old.listen()

        def refuse() -> None:
            peer, _ = old.accept()
            with peer:
                peer.recv(1_000)
                peer.sendall(encode_response(Response(error="unknown command 'snapshot'")))

        thread = threading.Thread(target=refuse)
        thread.start()
        network = SyntheticNetwork(5, 4, 24, is_ring=True)
        with (
            serve_network(network, tmp_path) as nodes,
            running([*nodes, tmp_path / "hung", tmp_path / "old"]) as server,
        ):
            assert len(server.scene.graph.nodes) == 11
        thread.join()
