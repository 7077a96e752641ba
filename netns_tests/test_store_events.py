"""Windows around events on real processes: a mark by hand, and what a holder then has."""

from __future__ import annotations

import json

import pytest

from netns_tests.history_site import TOPICS, content, ended, history_site, messages
from netns_tests.session_lab import PATIENCE_S

pytestmark = pytest.mark.netns


def test_what_stands_around_a_mark_is_held_and_exported() -> None:
    with history_site(8.0) as site:
        robot = site.drive_past(before="1s", after="1s")
        while json.loads(robot.read_line(PATIENCE_S)).get("sent", 0) < len(site.drive) / 2:
            pass
        marked = json.loads(site.lab.output("gdp", "store", "mark", "bumped", "--node", "robot", "--json"))
        assert marked["topics"] == len(TOPICS)
        _, lines = ended(robot)
        assert lines[-1]["event"] == "done"
        code, held = site.export("held.mcap")
        assert code == 0
        assert all(len(each) >= 8 for each in content(held).values())
        assert 2e9 < held[-1].stamp_ns - held[0].stamp_ns < 5.5e9
        assert all(places == list(range(places[0], places[-1] + 1)) for places in site.places(held).values())
        window = ("--from", "mark:bumped", "--to", "mark:bumped", "--json")
        words = ["gdp", "store", "export", *TOPICS, "--node", "player", "-o", "window.mcap", *window]
        exported = [json.loads(line) for line in site.lab.output(*words).splitlines()]
        assert exported[-1]["messages"] == len(messages(site.lab.folder / "window.mcap")) > 0
        assert exported[0]["problems"] == []
        unknown = site.lab.run(*words[:-6], "other.mcap", "--from", "mark:crashed")
        assert (unknown.returncode, "known marks: bumped" in unknown.stderr) == (2, True)
        for line in site.lab.output("gdp", "store", "ls", "--store", str(site.store), "--json").splitlines():
            name = json.loads(line)["capsule"]
            shown = json.loads(site.lab.output("gdp", "store", "show", name, "--store", str(site.store), "--json"))
            assert len(shown["marks"]) == 1
            site.lab.output("gdp", "store", "verify", name, "--store", str(site.store))
        assert not any(b"bumped" in path.read_bytes() for path in site.store.rglob("*") if path.is_file())
