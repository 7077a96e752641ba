"""Direct tunnels between the switches of two sites behind NATs, through real NATs and WireGuard, by one border."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from internet.access import Access
from internet.host import Host
from internet.laboratory import Laboratory
from internet.overlay import Overlay
from lab.process import until

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about tunnels, no lease of a name matters"),
    pytest.mark.skipif(shutil.which("wireguard-go") is None, reason="wireguard-go is not installed"),
    pytest.mark.skipif(os.geteuid() != 0, reason="wireguard-go needs root for its control socket"),
]

PATIENCE_S = 150.0


@dataclass
class Sites:
    """Two switches that know the border only."""

    overlay: Overlay
    one: Host
    other: Host

    def direct_endpoint(self, host: Host) -> str | None:
        """Return the endpoint of the peer behind a direct tunnel that is up, or None."""
        links = self.overlay.tunnels(host).values()
        return next((str(each["endpoint"]) for each in links if each["direct"] and each["up"]), None)

    def wait_until_direct(self, address: str = "") -> None:
        """Return when both switches have a direct tunnel; the second one's leads to this address, if given."""
        until(
            lambda: self.direct_endpoint(self.one) is not None and address in (self.direct_endpoint(self.other) or "-"),
            lambda: f"a direct tunnel: {[self.overlay.tunnels(host) for host in (self.one, self.other)]}",
            PATIENCE_S,
        )


@pytest.fixture
def make_sites(laboratory: Laboratory) -> Callable[[Access, Access], Sites]:
    def make(*accesses: Access) -> Sites:
        border = laboratory.add_host("border", laboratory.add_site("of-border", Access.PUBLIC))
        overlay = Overlay(laboratory, border, {"backend": "wireguard-go"})
        hosts = [
            laboratory.add_host(label, laboratory.add_site(f"of-{label}", access))
            for label, access in zip(("one", "other"), accesses, strict=True)
        ]
        overlay.stand_up(*hosts)
        return Sites(overlay, *hosts)

    return make


@pytest.mark.nightly
@pytest.mark.parametrize("other", [Access.FULL_CONE])
def test_a_symmetric_nat_reaches_one_that_filters_nothing(
    make_sites: Callable[[Access, Access], Sites], other: Access
) -> None:
    make_sites(Access.SYMMETRIC, other).wait_until_direct()


def test_a_site_behind_a_nat_that_gets_another_address_has_a_direct_tunnel_again(
    make_sites: Callable[[Access, Access], Sites],
) -> None:
    sites = make_sites(Access.PORT_RESTRICTED, Access.PORT_RESTRICTED)
    sites.wait_until_direct()
    site = sites.one.site()
    site.renumber()
    sites.wait_until_direct(site.address)
