"""Headers made by hypothesis, for tests that compare the codec, the Scapy layer and the kernel program."""

from __future__ import annotations

from hypothesis import strategies as st

from gdp.frame.codec import Header
from gdp.limits import PARTS_MAX

names = st.binary(min_size=32, max_size=32)
u8, u16, u32, u64 = (st.integers(0, (1 << bits) - 1) for bits in (8, 16, 32, 64))


@st.composite
def headers(draw: st.DrawFn, length: int) -> Header:
    """Header that a receiver accepts, for a payload of ``length`` bytes."""
    parts = draw(st.integers(1, PARTS_MAX))
    return Header(
        kind=draw(u8),
        flags=draw(u8),
        hops_left=draw(u8),
        epoch=draw(u16),
        length=length,
        number=draw(u64),
        part=draw(st.integers(0, parts - 1)),
        parts=parts,
        incarnation=draw(u64),
        destination=draw(names),
        source=draw(names),
        pace=draw(u8),
    )


@st.composite
def frames(draw: st.DrawFn) -> tuple[Header, bytes, bytes]:
    """Header, its payload, and padding behind it."""
    payload = draw(st.binary(max_size=64))
    return draw(headers(len(payload))), payload, draw(st.binary(max_size=46))
