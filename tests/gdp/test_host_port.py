"""Text form of a host and a port."""

from __future__ import annotations

import pytest

from gdp.errors import LocalError
from gdp.host_port import split_host_port


@pytest.mark.parametrize(
    ("text", "parts"),
    [("host:1", ("host", 1)), ("192.0.2.1:65535", ("192.0.2.1", 65_535)), ("[2001:db8::1]:80", ("2001:db8::1", 80))],
)
def test_a_host_and_a_port_are_split_and_brackets_removed(text: str, parts: tuple[str, int]) -> None:
    assert split_host_port(text) == parts


@pytest.mark.parametrize(
    "text",
    [
        *("", "host", ":1", "host:", "host:0", "host:65536", "host:\u0661", "h\u00f6st:1", "a" * 200 + ":1"),
        *("2001:db8::1:80", "[]:1", "[host:1", "host]:1", "a b:1"),
    ],
)
def test_what_is_no_host_and_port_is_refused(text: str) -> None:
    with pytest.raises(LocalError, match="host:port"):
        split_host_port(text)
