"""Addresses as people state them."""

from __future__ import annotations

import pytest

from gdp.enrolment.addresses import server_text
from gdp.errors import LocalError


@pytest.mark.parametrize(
    ("stated", "read"),
    [
        ("border.example.org", "border.example.org:51820"),
        ("border.example.org:443", "border.example.org:443"),
        ("198.51.100.7", "198.51.100.7:51820"),
        ("2001:db8::a", "[2001:db8::a]:51820"),
        ("[2001:db8::a]", "[2001:db8::a]:51820"),
        ("[2001:db8::a]:443", "[2001:db8::a]:443"),
    ],
)
def test_a_server_is_read_with_and_without_a_port(stated: str, read: str) -> None:
    assert server_text(stated, 51_820) == read


@pytest.mark.parametrize("stated", ["", "[]", "a b", "host:0", "host:x"])
def test_what_is_no_server_is_refused(stated: str) -> None:
    with pytest.raises(LocalError):
        server_text(stated, 51_820)
