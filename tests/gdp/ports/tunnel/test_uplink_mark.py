"""Marks of uplinks."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gdp.ports.tunnel.uplink_routes import mark_of

NAMES = st.text(min_size=1, max_size=15)


@given(NAMES)
def test_a_mark_is_no_table_of_the_system_and_has_no_bit_of_kubernetes(ifname: str) -> None:
    mark = mark_of(ifname)
    assert 1 << 30 <= mark < 1 << 31
    assert mark & 0xE000 == 0


@given(NAMES)
def test_a_mark_is_not_one_of_tailscale(ifname: str) -> None:
    assert mark_of(ifname) & 0xFF0000 not in (0x40000, 0x80000)
