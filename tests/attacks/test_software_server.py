"""Attacks of strangers and machines on the server of a site's software."""

from __future__ import annotations

import json
import socket
import ssl
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from fog.software.server import SOFTWARE_FILE
from tests.fog.software.test_software import Supply, supply

__all__ = ["supply"]

STRANGERS = 40  # more than the server's connections at once


def described(supply: Supply) -> dict[str, str]:
    found: dict[str, str] = json.loads(supply.server.bundle_file(60.0)[SOFTWARE_FILE])
    return found


def trust(found: dict[str, str]) -> ssl.SSLContext:
    context = ssl.create_default_context(cadata=found["certificate"])
    context.check_hostname = False
    return context


@pytest.fixture
def strangers() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def crowd(supply: Supply, strangers: ExitStack, sent: bytes | None) -> None:
    """Connect as many strangers; each says nothing, or begins a request and goes on no further."""
    found = described(supply)
    where = urlsplit(found["url"])
    assert where.hostname is not None
    for _ in range(STRANGERS):
        made = strangers.enter_context(socket.create_connection((where.hostname, where.port or 0), timeout=10.0))
        if sent is not None:
            try:
                made = strangers.enter_context(trust(found).wrap_socket(made))
                made.sendall(sent)
            except OSError:  # the server gave its place to another one
                continue


@pytest.mark.parametrize("sent", [None, b"GET /", b"GET /1-2.3/4 HTTP/1.1\r\n\r\n"])
def test_a86_idle_strangers_keep_no_machine_from_its_software(
    supply: Supply, strangers: ExitStack, tmp_path: Path, sent: bytes | None
) -> None:
    crowd(supply, strangers, sent)
    done = supply.fetch(supply.server.bundle_file(60.0), tmp_path / "got")
    assert done.returncode == 0, done.stderr


def test_a87_a_machine_that_asks_for_invented_files_costs_no_memory(supply: Supply) -> None:
    found = described(supply)
    opener = urllib.request.build_opener(urllib.request.HTTPSHandler(context=trust(found)))
    for number in range(20):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            opener.open(f"{found['url']}/{number:064x}", timeout=10.0)
    assert not supply.server._fetches
