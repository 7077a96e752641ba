"""MTUs inside a tunnel, for every path."""

from __future__ import annotations

import pytest

from gdp.ports.tunnel.path_mtu import tunnel_mtu


@pytest.mark.parametrize(
    ("outer", "is_ipv6", "wireguard", "vxlan"),
    [
        (1500, False, 1440, 1370),
        (1500, True, 1420, 1338),
        (1492, False, 1432, 1354),  # PPPoE
        (1300, False, 1280, 1162),  # an IPv6 device cannot be narrower; the VXLAN device is
        (9_000, False, 8_940, 8_858),
        (65_536, False, 8_940, 8_858),  # loopback
    ],
)
def test_the_mtus_of_usual_paths(outer: int, is_ipv6: bool, wireguard: int, vxlan: int) -> None:
    assert tunnel_mtu(outer, is_ipv6) == (wireguard, vxlan)


@pytest.mark.parametrize("is_ipv6", [False, True])
def test_a_padded_packet_never_exceeds_the_path(is_ipv6: bool) -> None:
    for outer in range(1_000, 2_000):
        _, vxlan = tunnel_mtu(outer, is_ipv6)
        plaintext = vxlan + 14 + 8 + 8 + 40  # Ethernet, VXLAN, UDP, IPv6
        padded = -(-plaintext // 16) * 16
        assert padded + 32 + 8 + (40 if is_ipv6 else 20) <= outer
