"""Control sockets: their permissions, their remains, and the responses to clients."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from gdp.errors import LocalError
from gdp.management.control_client import NotRunningError, ask_node, find_control_socket, request_control
from gdp.management.control_socket import (
    CONTROL_SOCKET,
    ControlHandlers,
    ControlServer,
    connect_control,
    serve_control_in_thread,
)
from gdp.state.control_protocol import LINE_MAX_BYTES, Command, Response, decode_response

WAIT_S = 5.0


class Node:
    """Handlers that record their requests."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.refusal = ""
        self.complete = True

    def handlers(self) -> ControlHandlers:
        return ControlHandlers(
            reload=self._reload,
            status=lambda: {"role": "test"},
            drain=lambda: self.asked.append("drain"),
            is_drained=lambda: self.complete,
        )

    def _reload(self) -> None:
        self.asked.append("reload")
        if self.refusal:
            raise LocalError(self.refusal)


@pytest.fixture
def node() -> Node:
    return Node()


@pytest.fixture
def path(tmp_path: Path, node: Node) -> Iterator[Path]:
    with serve_control_in_thread(tmp_path / CONTROL_SOCKET, node.handlers()):
        yield tmp_path / CONTROL_SOCKET


def test_a_node_reloads_on_request(path: Path, node: Node) -> None:
    assert ask_node(path, Command.RELOAD, WAIT_S) == Response({"state": "reloaded"})
    assert node.asked == ["reload"]


def test_a_client_learns_why_a_node_did_not_reload(path: Path, node: Node) -> None:
    node.refusal = "proxy.yaml:3:1: iface: required"
    assert ask_node(path, Command.RELOAD, WAIT_S) == Response(error=node.refusal)


def test_status_has_the_state_and_the_fields_of_the_node(path: Path) -> None:
    result = ask_node(path, Command.STATUS, WAIT_S).result
    assert result == {"state": "running", "pid": os.getpid(), "role": "test"}


@pytest.mark.parametrize("complete", [True, False])
def test_a_client_that_drains_is_answered_again_at_the_end(tmp_path: Path, node: Node, complete: bool) -> None:
    node.complete = complete
    with serve_control_in_thread(tmp_path / CONTROL_SOCKET, node.handlers()):
        responses = request_control(tmp_path / CONTROL_SOCKET, Command.DRAIN, WAIT_S)
        assert next(responses).result == {"state": "draining"}
        assert ask_node(tmp_path / CONTROL_SOCKET, Command.STATUS, WAIT_S).result["state"] == "draining"
    assert next(responses).result == {"state": "drained", "complete": complete}
    assert node.asked == ["drain"]


def test_a_second_drain_waits_for_the_first(tmp_path: Path, node: Node) -> None:
    with serve_control_in_thread(tmp_path / CONTROL_SOCKET, node.handlers()):
        both = [request_control(tmp_path / CONTROL_SOCKET, Command.DRAIN, WAIT_S) for _ in range(2)]
        assert [next(each).result["state"] for each in both] == ["draining", "draining"]
    assert [next(each).result["state"] for each in both] == ["drained", "drained"]
    assert node.asked == ["drain"]


def test_a_wrong_request_is_answered_and_the_next_one_served(path: Path) -> None:
    with connect_control(path, WAIT_S) as client, client.makefile("rb") as lines:
        client.sendall(b'{"command": "dance"}\n')
        assert "unknown command" in decode_response(lines.readline()).error
        client.sendall(b'{"command": "status"}\n')
        assert decode_response(lines.readline()).is_ok


def test_a_request_without_end_closes_its_connection_only(path: Path) -> None:
    with connect_control(path, WAIT_S) as client, client.makefile("rb") as lines:
        client.sendall(b"x" * LINE_MAX_BYTES)
        assert "at most" in decode_response(lines.readline()).error
        assert lines.read() == b""
    assert ask_node(path, Command.STATUS, WAIT_S).is_ok


def test_only_the_owner_reaches_the_socket(path: Path) -> None:
    assert path.stat().st_mode & 0o777 == 0o600


def test_the_socket_is_removed_at_the_end(tmp_path: Path, node: Node) -> None:
    with serve_control_in_thread(tmp_path / CONTROL_SOCKET, node.handlers()):
        pass
    assert not (tmp_path / CONTROL_SOCKET).exists()


def test_the_socket_of_a_dead_process_is_replaced(tmp_path: Path, node: Node) -> None:
    path = tmp_path / CONTROL_SOCKET
    dead = socket.socket(socket.AF_UNIX)
    dead.bind(str(path))
    dead.close()
    with serve_control_in_thread(path, node.handlers()):
        assert ask_node(path, Command.STATUS, WAIT_S).is_ok


def test_the_socket_of_a_live_process_is_left_alone(path: Path, node: Node) -> None:
    with pytest.raises(LocalError, match="a running process has this control socket"):
        ControlServer(path, node.handlers())
    assert ask_node(path, Command.STATUS, WAIT_S).is_ok


def test_a_file_that_is_no_socket_is_left_alone(tmp_path: Path, node: Node) -> None:
    path = tmp_path / CONTROL_SOCKET
    path.write_text("mine")
    with pytest.raises(LocalError, match="is no socket"):
        ControlServer(path, node.handlers())
    assert path.read_text() == "mine"


def test_a_path_longer_than_a_sockets_address_is_taken(tmp_path: Path, node: Node) -> None:
    folder = tmp_path / ("x" * 120)
    folder.mkdir()
    with serve_control_in_thread(folder / CONTROL_SOCKET, node.handlers()):
        assert ask_node(folder / CONTROL_SOCKET, Command.STATUS, WAIT_S).is_ok


def test_a_node_that_does_not_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(NotRunningError, match="no process serves"):
        ask_node(tmp_path / CONTROL_SOCKET, Command.STATUS, WAIT_S)


def test_a_folder_of_no_node_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match="expected the directory of a node"):
        find_control_socket(tmp_path)


def test_many_idle_clients_are_bounded(path: Path) -> None:
    clients = [connect_control(path, WAIT_S) for _ in range(16)]
    try:
        with pytest.raises(LocalError):
            ask_node(path, Command.STATUS, WAIT_S)
    finally:
        for client in clients:
            client.close()
