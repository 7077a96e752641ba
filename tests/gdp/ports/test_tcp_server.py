"""Networks by which servers count clients."""

from __future__ import annotations

import pytest

from gdp.ports.tcp_server import client_network


@pytest.mark.parametrize("same", ["2001:db8:0:1::7", "2001:db8:0:1:ffff:ffff:ffff:ffff", "2001:db8:0:1::1%eth0"])
def test_addresses_of_one_ipv6_subnet_are_one_client(same: str) -> None:
    assert client_network(same) == client_network("2001:db8:0:1::1")


@pytest.mark.parametrize("other", ["2001:db8:0:2::1", "192.0.2.1", "::ffff:192.0.2.1"])
def test_other_subnets_are_other_clients(other: str) -> None:
    assert client_network(other) != client_network("2001:db8:0:1::1")


def test_an_ipv4_address_is_one_client_in_either_form() -> None:
    assert client_network("::ffff:192.0.2.1") == client_network("192.0.2.1") != client_network("192.0.2.2")
