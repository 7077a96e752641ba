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
        site.lab.output("gdp", "store", "mark", "bumped hard", "--node", "robot")
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
        split = ["gdp", "store", "export", *TOPICS, "--node", "player", "-o", "each.mcap", "--mark", "bumped", "--json"]
        lines = [json.loads(line) for line in site.lab.output(*split).splitlines()]
        written = {line["file"]: line["messages"] for line in lines if line["event"] == "window"}
        assert written == {name: len(messages(site.lab.folder / name)) for name in ("each-1.mcap", "each-2.mcap")}
        assert lines[-1]["messages"] == sum(written.values()) > max(written.values())
        refused = site.lab.run(*split, "--from", "mark:bumped")
        assert (refused.returncode, "leave out --from and --to" in refused.stderr) == (2, True)
        unknown = site.lab.run(*words[:-6], "other.mcap", "--from", "mark:crashed")
        assert (unknown.returncode, "known marks: bumped, bumped hard" in unknown.stderr) == (2, True)
        for line in site.lab.output("gdp", "store", "ls", "--store", str(site.store), "--json").splitlines():
            name = json.loads(line)["capsule"]
            shown = json.loads(site.lab.output("gdp", "store", "show", name, "--store", str(site.store), "--json"))
            assert len(shown["marks"]) == 2
            site.lab.output("gdp", "store", "verify", name, "--store", str(site.store))
        assert not any(b"bumped" in path.read_bytes() for path in site.store.rglob("*") if path.is_file())
