"""Kills of a robot and of its holder while both write: what was confirmed stays, and the capsule stays whole."""

from __future__ import annotations

import json
import random

import pytest

from lab.process import LabProcess
from netns_tests.history_site import TOPICS, Site, ended, history_site
from netns_tests.session_lab import PATIENCE_S, lines_of
from tests.draws import TIMES

pytestmark = pytest.mark.netns

KILLS = 2 * TIMES


def stored(site: Site) -> dict[str, bytes]:
    """Return the bytes of each capsule on the holder's disk; each has begun, and none has ended its first file."""
    return {path.parent.name: path.read_bytes() for path in sorted(site.store.rglob("*.records"))}


def hold(site: Site) -> LabProcess:
    holder = site.lab.launch(["gdp", "store", "serve", "holder", "--store", str(site.store), "--json"])
    assert '"ready"' in lines_of(holder, 1)[0]
    return holder


def test_nothing_confirmed_is_lost_when_the_robot_and_its_holder_are_killed() -> None:
    rng = random.Random(5)
    with history_site(4.0) as site:
        holder = site.holder
        before: dict[str, bytes] = {}
        for number in range(KILLS):
            robot = site.drive_past()
            sent, at = 0, rng.randrange(20, len(site.drive) * 2 // 3)
            while sent < at:
                sent = int(json.loads(robot.read_line(PATIENCE_S)).get("sent", 0))
            if number % 2:
                site.lab.kill(holder)
                holder = hold(site)
            site.lab.kill(robot)
            now = stored(site)
            assert all(now[name].startswith(data) for name, data in before.items())
            before = now
        robot = site.drive_past()
        _, lines = ended(robot)
        assert lines[-1]["event"] == "done"
        now = stored(site)
        assert len(now) == len(TOPICS), "a robot that starts again continues its capsules"
        assert all(now[name].startswith(data) for name, data in before.items())
        for name in now:
            site.lab.output("gdp", "store", "verify", name, "--store", str(site.store))
        _, exported = site.export("all.mcap")  # what a killed robot had not written is a gap in its own numbers
        whole, places = site.all, site.places(exported)
        assert all(places[topic][-len(whole[topic]) :] == whole[topic] for topic in TOPICS)
