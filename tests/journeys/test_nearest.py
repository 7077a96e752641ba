"""Requests to the nearest replica: it answers each one, the next takes over from a dead one, a robot may roam."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gdp.intervals import OWING
from lab.sites import Request, Sites
from tests.draws import draws
from tests.lanes import nightly

MOVED_S, BACK_S, TAKEN_OVER_S = 1.0, 3.0, 0.3
NOTICED_S: Final = TAKEN_OVER_S + OWING.lease_s  # a replica that hears no one reports until it has lost its switch
EVERY_S: Final = 0.05
SLACK_S: Final = 0.01  # forwarding and links of hosts

pytestmark = pytest.mark.momentary("it is about seconds after a change, and all leases stand meanwhile")


def served_by(requests: list[Request]) -> list[int]:
    return [int(each.by[1]) for each in requests]


def begun_between(sites: Sites, from_s: float, to_s: float) -> list[Request]:
    return [each for each in sites.requests if from_s <= each.begun_s < to_s]


def test_a_robot_that_roams_asks_the_nearest_replica_alone_within_a_second() -> None:
    sites = Sites(size=3_000)
    sites.call_often(9.0)
    for place in (0, 1, 2):
        sites.roam(place)
        moved_s, sites.uplink_bytes = sites.now_s, 0
        sites.run(MOVED_S)
        sites.uplink_bytes = 0
        sites.run(2.0)
        settled = begun_between(sites, moved_s + MOVED_S, sites.now_s - 0.05)
        assert set(served_by(settled)) == {place}
        assert sites.uplink_bytes < 1.3 * 3_000 * len(settled)
    assert all(len(each) == 1 for each in sites.executed.values())


@pytest.mark.parametrize(
    ("how", "work_s"),
    [
        *(("kill", 0.0), ("kill", 0.5), ("freeze", 0.5), ("cut to", 0.5), ("cut from", 0.0)),
        *nightly(("freeze", 0.0), ("cut to", 0.0), ("cut from", 0.5)),
    ],
)
def test_the_next_replica_answers_what_a_dead_one_owed(how: str, work_s: float) -> None:
    sites = Sites(work_s=work_s)
    die: dict[str, Callable[[int], None]] = {
        "kill": sites.kill, "freeze": sites.freeze,
        "cut to": partial(sites.cut, is_out=True), "cut from": partial(sites.cut, is_out=False),
    }  # fmt: skip
    sites.call_often(4.0, EVERY_S)
    sites.run(1.0)
    die[how](0)
    died_s = sites.now_s
    sites.run(5.0)
    begun = [each for each in sites.requests if each.answered_s > died_s + sites.trip_s(0) and each.begun_s < died_s]
    assert set(served_by(begun)) <= ({0, 1} if how == "cut to" else {1})  # what it has, it may answer
    late_s = (NOTICED_S if how == "cut to" else TAKEN_OVER_S) + sites.trip_s(1) + work_s
    assert min(each.answered_s for each in sites.requests if each.by == sites.label(1)) - died_s <= late_s
    assert all(each.answered_s - max(each.begun_s, died_s) <= late_s + SLACK_S for each in begun)
    after = begun_between(sites, died_s + NOTICED_S, sites.now_s)
    assert set(served_by(after)) == {1}
    assert all(each.answered_s - each.begun_s <= sites.trip_s(1) + work_s + SLACK_S for each in after)


@dataclass(frozen=True)
class Change:
    """What happens, after a pause."""

    kind: str
    site: int
    pause_s: float


@dataclass(frozen=True)
class Plan:
    """Sites in a row, and what happens."""

    order: tuple[int, ...]
    apart_s: tuple[float, ...]
    work_s: float
    changes: tuple[Change, ...]
    seed: int


KINDS: Final = ("roam", "kill", "freeze", "cut to", "cut from", "back", "farther")


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Draw a plan."""
    count = draw(st.integers(2, 4))
    return Plan(
        tuple(draw(st.permutations(range(count)))),
        tuple(draw(st.lists(st.sampled_from([0.005, 0.015, 0.06]), min_size=count - 1, max_size=count - 1))),
        draw(st.sampled_from([0.0, 0.02, 0.4])),
        tuple(
            Change(draw(st.sampled_from(KINDS)), draw(st.integers(0, count - 1)), draw(st.floats(3.5, 4.5)))
            for _ in range(draw(st.integers(3, 8)))
        ),
        draw(st.integers(1, 1_000)),
    )


class Trial:
    """One plan: each change, and what it promises."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.sites = Sites(plan.apart_s, order=plan.order, work_s=plan.work_s, is_measured=False, seed=plan.seed)
        self._gone: dict[int, str] = {}

    def run(self) -> None:
        """Run all changes, and check after each."""
        sites = self.sites
        sites.call_often(sum(each.pause_s for each in self.plan.changes) + 4.0, EVERY_S)
        sites.run(2.0)
        for change in self.plan.changes:
            before, changed_s = sites.nearest(), sites.now_s
            settles_s = self._change(change)
            sites.run(change.pause_s)
            self._check(change, changed_s, settles_s, before)
        sites.run(4.0)
        assert all(each.by for each in sites.requests), [each.call.error for each in sites.requests if not each.by]
        for label in sites.cores:
            for asked, by in sites.executed.items():
                assert by.count(label) <= 1, (asked, by)

    def _change(self, change: Change) -> float:
        """Apply a change; return after how many seconds all must be as it says."""
        sites, site = self.sites, change.site
        how = self._gone.get(site)
        if change.kind == "roam":
            sites.roam(site)
            return MOVED_S
        if change.kind == "farther":
            if site < len(self.plan.apart_s):
                sites.set_delay(f"a{site}", f"a{site + 1}", 0.04)
            return MOVED_S
        if change.kind == "back":
            {"kill": sites.restart, "freeze": sites.thaw, "cut to": sites.join, "cut from": sites.join}.get(
                how or "", lambda _: None
            )(site)
            self._gone.pop(site, None)
            return BACK_S
        if how is None and len(sites.out) + 1 < len(self.plan.order):
            self._gone[site] = change.kind
            if change.kind == "kill":
                sites.kill(site)
            elif change.kind == "freeze":
                sites.freeze(site)
            else:
                sites.cut(site, is_out=change.kind == "cut to")
        return MOVED_S

    def _check(self, change: Change, changed_s: float, settles_s: float, before: set[int]) -> None:
        sites, nearest = self.sites, self.sites.nearest()
        settled = begun_between(sites, changed_s + settles_s, sites.now_s - 1.5)
        wrong = [each for each in settled if not each.by or int(each.by[1]) not in nearest]
        assert not wrong, (change, nearest, [(each.begun_s - changed_s, each.by) for each in wrong])
        if change.site in before and change.site in sites.out and len(before) == 1:
            first_s = min(
                each.answered_s
                for each in sites.requests
                if each.by and int(each.by[1]) in nearest and each.answered_s > changed_s
            )
            trip_s = max(map(sites.trip_s, nearest))
            limit_s = NOTICED_S if change.kind == "cut to" else TAKEN_OVER_S
            assert first_s - changed_s <= limit_s + trip_s + self.plan.work_s + SLACK_S, (change, first_s - changed_s)


@draws(2, long=40)
@given(plans())
def test_each_request_is_answered_by_the_nearest_replica_whatever_changes(plan: Plan) -> None:
    Trial(plan).run()
