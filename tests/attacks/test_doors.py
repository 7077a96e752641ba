"""Hostile clients and users at a door, which must cost themselves their connection, and the others nothing."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import pytest

pytest.importorskip("websockets")

from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from gdp.errors import LocalError
from proxy.cli.door_token import door_token
from proxy.doors.rosbridge_session import RosbridgeSession
from proxy.endpoints.door import DoorEndpoint, DoorSettings
from tests.proxy.doors.rights import Everything
from tests.proxy.doors.test_foxglove_door import free_port

PATIENCE_S = 20.0
TOKEN = "t&ken of 24 characters/+"


@contextmanager
def door_of(token: str = "") -> Iterator[DoorEndpoint]:
    settings = DoorSettings(label="rosbridge", listen=f"127.0.0.1:{free_port()}", token=token)
    clock = count(1.0)
    door = DoorEndpoint(
        settings, lambda hub, number, queue: RosbridgeSession(hub, number, queue, lambda: next(clock)), Everything
    )
    try:
        yield door
    finally:
        door.shut_down()


def is_served(client: ClientConnection) -> bool:
    client.send(json.dumps({"op": "call_service", "service": "/rosapi/topics", "id": "ping"}))
    return json.loads(client.recv(PATIENCE_S))["id"] == "ping"


@pytest.mark.parametrize("query", ["", "/", "/?token=", "/?token=wrong", "/?token={0}&token={0}", "/?other={0}", "/{0}"])
def test_z02_another_user_of_the_host_does_not_enter_a_door(query: str) -> None:
    with door_of("known") as door:
        address = "ws://{}:{}".format(*door.address) + query.format("known")
        with pytest.raises(InvalidStatus) as caught, connect(address):
            pass
        assert caught.value.response.status_code == 401
        assert b"known" not in (caught.value.response.body or b"")


def test_z02_the_printed_url_leads_in_and_no_other_text_shows_the_token(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG), door_of(TOKEN) as door, connect(door.url) as client:
        assert is_served(client)
        logged = [each.getMessage() for each in caplog.records if each.name != "websockets.client"]
        shown = f"{door.label} {door._settings!r} {logged}"
        assert TOKEN not in shown
        assert "%26ken" not in shown


def test_z02_a_door_has_a_new_token_at_each_start_unless_a_private_file_names_one(tmp_path: Path) -> None:
    first, second = (door_token(None, no_token=False) for _ in range(2))
    assert len(first) >= 32
    assert first != second
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    file.chmod(0o600)
    assert door_token(file, no_token=False) == TOKEN
    file.write_text("short")
    with pytest.raises(LocalError, match="at least 16 characters"):
        door_token(file, no_token=False)


def test_z02_a_door_without_a_token_says_so(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert door_token(None, no_token=True) == ""
    assert "every user of this host" in caplog.text
    with door_of() as door, connect(door.url) as client:
        assert is_served(client)
