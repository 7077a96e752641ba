"""Striping of large messages: shares at the reader, and the choice of paths at the writer."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.frame.codec import HOPS_AT, SECOND_PATH, Header, Kind, encode
from gdp.limits import HOPS_MAX
from gdp.message.striping import SHARE_WHOLE, StripedPaths, Striper
from gdp.names import Name

PARTS = 100
READER = b"r" * 32


def frames(first: int, count: int, parts: int = PARTS) -> list[bytes]:
    name = Name(bytes(32))
    return [encode(Header(Kind.DATA, 0, HOPS_MAX, 0, 0, 1, part, parts, 1, name, name)) for part in range(first, count)]


def second(out: list[bytes]) -> int:
    return sum(frame[HOPS_AT] & SECOND_PATH > 0 for frame in out)


def received(paths: StripedPaths, number: int, ends_s: tuple[float | None, float | None]) -> None:
    paths.handle_arrivals(number, 1, 0, 0.0) if ends_s[0] is not None else paths.handle_arrivals(number, 0, 1, 0.0)
    for at_s, first in sorted((end_s, path == 0) for path, end_s in enumerate(ends_s) if end_s is not None):
        paths.handle_arrivals(number, int(first), int(not first), at_s)
    paths.handle_complete(number)


@given(st.integers(0, SHARE_WHOLE))
def test_a_writer_sends_the_share_that_its_reader_wants(share: int) -> None:
    striper = Striper()
    striper.handle_share(READER, share)
    out = [frame for _ in range(4) for frame in striper.stripe(frames(1, PARTS), 0, [READER])]
    assert len(out) == 4 * (PARTS - 1)
    assert second(out) == pytest.approx(share / SHARE_WHOLE * len(out), abs=1)


def test_the_first_fragment_short_messages_and_repairs_take_both_paths() -> None:
    striper = Striper()
    striper.handle_share(READER, 0)
    assert second(striper.stripe(frames(0, 1), 0, [READER])) == 1
    assert second(striper.stripe(frames(0, 3, 3), 0, [READER])) == 3
    assert second(striper.stripe(frames(1, 11), 10, [READER])) == 10


def test_a_reader_that_left_has_no_say() -> None:
    striper = Striper()
    striper.handle_share(READER, 0)
    striper.handle_share(b"s" * 32, SHARE_WHOLE)
    assert striper.share([READER, b"s" * 32]) == 0.5
    assert striper.share([READER]) == 0.0


@pytest.mark.parametrize(("ends_s", "grows"), [((0.1, 0.05), True), ((0.05, 0.1), False)])
def test_the_path_that_ends_first_gets_more(ends_s: tuple[float, float], grows: bool) -> None:
    paths = StripedPaths()
    received(paths, 1, ends_s)
    assert (paths.share > 0.5) is grows
    assert paths.lag_s() == pytest.approx(1.25 * 0.05)


@pytest.mark.parametrize(("ends_s", "share"), [((0.1, None), 0.0), ((None, 0.1), 1.0)])
def test_a_path_that_brings_nothing_gets_nothing(ends_s: tuple[float | None, float | None], share: float) -> None:
    paths = StripedPaths()
    received(paths, 1, ends_s)
    assert paths.share == share
    assert paths.has_news
    assert paths.poll_share() == round(share * SHARE_WHOLE)
    assert not paths.has_news


def test_a_message_that_comes_at_once_shows_nothing() -> None:
    paths = StripedPaths()
    received(paths, 1, (0.0005, 0.001))
    assert paths.share == 0.5


@given(st.lists(st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)), max_size=200))
def test_a_share_is_never_outside_its_bounds(ends: list[tuple[float, float]]) -> None:
    paths = StripedPaths()
    for number, ends_s in enumerate(ends):
        received(paths, number, ends_s)
        assert 0.0 <= paths.share <= 1.0
        assert 0.0 <= paths.lag_s() <= 1.0
