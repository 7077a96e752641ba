"""Capsules read at the nearest holder: a death in mid-transfer costs 300 ms and no record; who roamed reads near."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.errors import StoreError
from gdp.names import Name
from gdp.session.protocol.errors import NoServerError, SessionTimeoutError
from lab.holder_sites import HolderSites, Reading
from tests.draws import draws

CHANGED_S: Final = 0.3
SIZE: Final = 60_000
SITES: Final = 3

pytestmark = pytest.mark.momentary("it is about seconds after a change, and all leases stand meanwhile")


@dataclass(frozen=True)
class Plan:
    """Where the robot is, after how many messages a holder dies and how, and where the robot is then."""

    order: tuple[int, ...]
    at: int
    after: int
    how: str
    then: int


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Draw a plan."""
    order = tuple(draw(st.permutations(range(SITES))))
    at, then = draw(st.integers(0, SITES - 1)), draw(st.integers(0, SITES - 1))
    return Plan(order, at, draw(st.integers(1, 35)), draw(st.sampled_from(["kill", "freeze"])), then)


def sites_at(folder: str | Path, **settings: object) -> HolderSites:
    """Return three holders behind 5, 20 and 80 ms."""
    return HolderSites(size=SIZE, folder=Path(folder), **settings)  # type: ignore[arg-type]


def is_whole(sites: HolderSites, reading: Reading) -> None:
    """Check that each record came once, in order."""
    assert reading.reader is not None
    assert [each.message for each in reading.kept] == sites.sent
    assert (reading.reader.audit.findings, reading.reader.lost) == ([], [])


@draws(2, long=30)
@given(plans())
def test_a_reading_stays_at_the_nearest_holder_and_changes_when_that_dies(plan: Plan) -> None:
    with tempfile.TemporaryDirectory() as folder:
        sites = sites_at(folder, order=plan.order)
        sites.roam(plan.at)
        sites.run(1.0)
        (first,) = sites.nearest()
        reading, begun_s = sites.begin_reading(), sites.now_s
        assert sites.read(reading, 20, lambda: len(reading.kept) >= plan.after)
        assert {site for _, site in sites.reads_since(begun_s)} == {first}
        getattr(sites, plan.how)(first)
        died_s = sites.now_s
        (following,) = sites.nearest()
        assert sites.read(reading, 30)
        is_whole(sites, reading)
        later = [(at_s, site) for at_s, site in sites.reads_since(died_s) if site != first]
        assert {site for _, site in later[:-1]} <= {following}
        assert later[0][0] - died_s - sites.trip_s(following) / 2 <= CHANGED_S
        assert [each.holder for each in reading.holder.choices] == [sites.service(first), sites.service(following)]
        sites.roam(plan.then)
        sites.run(3.0)
        (near,) = sites.nearest()
        again, begun_s = sites.begin_reading(), sites.now_s
        assert sites.read(again, 30)
        is_whole(sites, again)
        assert [each.holder for each in again.holder.choices] == [sites.service(near)]
        sites.close()


def test_a_nearest_holder_that_lacks_records_is_no_end(tmp_path: Path) -> None:
    sites = sites_at(tmp_path, lacking=0)
    reading = sites.begin_reading()
    assert sites.read(reading, 30)
    is_whole(sites, reading)
    assert [each.holder for each in reading.holder.choices] == ["store-0", "store-1"]
    assert {site for _, site in sites.reads_since(0)} == {0, 1, 2}  # whether the farthest has still more


def test_a_reading_stays_where_it_is_when_a_nearer_holder_returns(tmp_path: Path) -> None:
    sites = sites_at(tmp_path)
    reading = sites.begin_reading()
    sites.read(reading, 20, lambda: len(reading.kept) >= 5)
    sites.kill(0)
    sites.read(reading, 20, lambda: len(reading.kept) >= 20)
    sites.restart(0)
    sites.run(2.0)
    returned_s = sites.now_s
    assert sites.nearest() == {0}
    assert sites.read(reading, 30)
    is_whole(sites, reading)
    assert [site for _, site in sites.reads_since(returned_s)][:-2] == [1] * (len(sites.reads_since(returned_s)) - 2)
    assert [each.holder for each in reading.holder.choices] == ["store-0", "store-1"]


def test_a_holder_that_refuses_is_named_and_another_one_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sites = sites_at(tmp_path)

    def refuse(wire: bytes, _client: Name) -> bytes:
        raise StoreError(f"the bucket is slow for {len(wire)} bytes")

    monkeypatch.setattr(sites.stores["s0/edge0"], "handle", refuse)
    reading = sites.begin_reading()
    assert sites.read(reading, 30)
    is_whole(sites, reading)
    (choice,) = reading.holder.choices
    assert choice.holder == "store-1"
    assert "; store-0: every server refused: the bucket is slow" in choice.words()


def test_a_reading_is_no_shorter_than_what_a_dead_holder_had(tmp_path: Path) -> None:
    sites = sites_at(tmp_path, lacking=1)
    sites.kill(2)
    sites.run(4.0)
    reading = sites.begin_reading()
    sites.read(reading, 20, lambda: len(reading.kept) >= 40)
    sites.kill(0)
    with pytest.raises(SessionTimeoutError, match="store-0: no response"):
        sites.read(reading, 30)
    assert len(sites.sent) / 2 < len(reading.kept) < len(sites.sent)


@pytest.mark.parametrize("dead", [(0,), (0, 1), (1, 2)])
def test_holders_that_are_gone_before_it_begins_delay_a_reading_once(tmp_path: Path, dead: tuple[int, ...]) -> None:
    sites = sites_at(tmp_path)
    for site in dead:
        sites.kill(site)
    sites.run(4.0)
    reading, begun_s = sites.begin_reading(), sites.now_s
    assert sites.read(reading, 30)
    is_whole(sites, reading)
    (near,) = sites.nearest()
    (choice,) = reading.holder.choices
    assert choice.holder == sites.service(near)
    assert [each for each, cost in choice.costs.items() if cost is None] == [sites.service(each) for each in dead]
    assert f"{sites.service(dead[0])} does not answer" in choice.words()
    assert sites.reads_since(begun_s)[0][0] - begun_s <= 2.0


def test_without_a_holder_a_reading_fails_and_says_so(tmp_path: Path) -> None:
    sites = sites_at(tmp_path)
    for site in range(SITES):
        sites.kill(site)
    sites.run(4.0)
    reading = sites.begin_reading()
    with pytest.raises(NoServerError, match=r"store-0, store-1, store-2: no holder within 10 s"):
        sites.read(reading, 30)
