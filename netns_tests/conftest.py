"""Where real namespaces are allowed, and a fresh one for each test that wants it."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from netns_tests.spaces import Space


def _why_not() -> str:
    """Return why tests with real namespaces cannot run here; empty where they can."""
    try:
        with Space(), socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0):
            return ""
    except OSError as error:
        return f"needs root, or a user namespace with its own network: {error.strerror}"


_REASON = _why_not()


def pytest_runtest_setup(item: pytest.Item) -> None:
    if _REASON and item.get_closest_marker("netns"):
        pytest.skip(_REASON)


@pytest.fixture
def space() -> Iterator[Space]:
    """A network namespace of its own, in which the test runs."""
    with Space() as entered:
        yield entered
