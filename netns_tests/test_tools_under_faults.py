"""``gdp trace``, ``gdp ping`` and the live view while links of the ring are cut, full and back, for many leases.

They must say what is there, or that nothing came; none may wait for ever, and each must recover as the traffic does.
"""

from __future__ import annotations

import json
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from gdp.host.run_registry import RunRegistry
from lab.machine import GDP
from netns_tests.lifetimes import Lifetime, noted
from netns_tests.test_ring import command
from netns_tests.test_trace import labels, running
from tests.pages import ROOT

pytestmark = pytest.mark.netns

LEASE_S = 6
CUT, KILLED, FULL, LASTS_S = (14, 26), (34, 44), (52, 64), 76
EARLY_S = 4  # between the ring's start of traffic and ours
STRAIGHT = ["switch-nuc5", "switch-nuc4", "backbone", "school", "school"]
DETOUR = ["switch-nuc5", "school"]
BUDGET_S = 1.0
PING_S = 0.2
SLOWEST_MS = 3_000
USUAL_S = 4.0  # of a whole command; a slower machine may show no trace within a phase
THIN = ("tbf", "rate", "300kbit", "burst", "4kb", "limit", "64kb")  # less than the recording needs


@contextmanager
def full_link(namespaces: list[str]) -> Iterator[None]:
    """Make the link from nuc3 to nuc4 too thin for the traffic."""
    (space,) = (each for each in namespaces if each.endswith("nuc3"))
    words = ["nsenter", f"--net={space}", "tc", "qdisc"]
    subprocess.run([*words, "add", "dev", "nuc4", "root", *THIN], check=True)
    try:
        yield
    finally:
        subprocess.run([*words, "del", "dev", "nuc4", "root"], check=True)


class LiveView:
    """A page of ``gdp dashboard``, read until the connection ends.

    Attributes:
        gap_s: longest time between two messages.
    """

    def __init__(self, nodes: list[Path]) -> None:
        chosen = [word for each in nodes for word in ("--node", str(each))]
        self._process = subprocess.Popen(
            [*GDP, "dashboard", "--json", *chosen], stdout=subprocess.PIPE, text=True, cwd=ROOT
        )
        assert self._process.stdout is not None
        self._url = json.loads(self._process.stdout.readline())["url"].replace("http", "ws", 1) + "live"
        self.gap_s = 0.0
        self.events: list[str] = []
        self._reading = threading.Thread(target=self._read)
        self._reading.start()

    def _read(self) -> None:
        with suppress(ConnectionClosed), connect(self._url, max_size=None) as page:
            before_s = time.monotonic()
            while True:
                message = json.loads(page.recv())
                self.gap_s, before_s = max(self.gap_s, time.monotonic() - before_s), time.monotonic()
                self.events += [each["text"] for each in message.get("events", ())]

    def end(self) -> int:
        """End it with Ctrl-C; return its exit code."""
        self._process.send_signal(signal.SIGINT)
        self._process.communicate(timeout=30)
        self._reading.join(30)
        return self._process.returncode


def changes_of(view: LiveView, one: str, other: str) -> list[str]:
    """Return what the live view reported of a link, in order: ``lost`` or ``up``."""
    link = [each for each in view.events if each.startswith("link") and one in each and other in each]
    return [each.rpartition(" ")[2] for each in link]


def trace_once(node: Path) -> tuple[int, dict[str, Any], str]:
    """Return the exit code of a trace, its result and its complaint."""
    argv = [*GDP, "trace", "/scan", "--node", str(node), "-W", str(BUDGET_S), "--json"]
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60, check=False, cwd=ROOT)
    return done.returncode, json.loads(done.stdout) if done.stdout else {}, done.stderr


def is_one_of(found: list[object], *paths: list[str]) -> bool:
    """Return whether these labels are those of a path; a hop that lost its reply has none."""
    return any(
        len(found) == len(path) and all(label in (None, expected) for label, expected in zip(found, path, strict=True))
        for path in paths
    )


@pytest.mark.nightly
def test_tools_tell_the_truth_while_links_fail_and_recover(tmp_path: Path) -> None:
    printed = tmp_path / "ping.jsonl"  # a pipe that is read at the end only would fill, and ping would stop
    cut, killed = (f"{begin}-{end}" for begin, end in (CUT, KILLED))
    words = (
        "--seconds",
        LASTS_S + 20,
        "--lease",
        LEASE_S,
        "--cut",
        f"nuc1-nuc2@{cut}",
        "--kill",
        f"switch:nuc3@{killed}",
    )
    seen: list[tuple[float, int, dict[str, Any], str]] = []
    ended_s: list[float] = []  # of each trace; on a busy machine a command takes longer to start than to trace
    with running(command(*words), lambda line: "msg/s" in line) as ring:
        begun_s = time.monotonic()
        (run,) = (each for each in RunRegistry().all() if each.owner.pid == ring.pid)
        nodes = Path(run.files[0]) / "nodes"
        view = LiveView([nodes / each for each in ("switch-nuc1", "switch-nuc3", "switch-nuc5", "proxy-nuc5")])
        with printed.open("wb") as output:
            ping = subprocess.Popen(
                [*GDP, "ping", "/scan", "--node", str(nodes / "proxy-nuc5"), "-i", str(PING_S), "--json"],
                stdout=output,
                cwd=ROOT,
            )

        def trace_until(end_s: float) -> None:
            while (at_s := time.monotonic() - begun_s) < end_s:
                seen.append((at_s, *trace_once(nodes / "proxy-nuc5")))
                ended_s.append(time.monotonic() - begun_s)

        trace_until(FULL[0])
        with full_link(run.namespaces):
            trace_until(FULL[1])
        trace_until(LASTS_S)
        ping.send_signal(signal.SIGINT)
        assert ping.wait(30) == 0
        replies = [json.loads(line) for line in printed.read_text().splitlines()]
        noted.append(Lifetime("the ring under its tools", LEASE_S, time.monotonic() - begun_s))
        assert view.end() == 0
    for at_s, code, result, complaint in seen:
        print(f"{at_s:5.1f} s: exit {code}", [labels(each) for each in result.get("paths", [])], complaint.strip())
    print(f"longest silence of the live view: {view.gap_s:.1f} s", *view.events, sep="\n  ")
    *pongs, summary = replies
    print("pings without a reply:", [each["number"] for each in pongs if each["rtt_ms"] is None], summary)

    for (at_s, code, result, complaint), done_s in zip(seen, ended_s, strict=True):
        assert result.get("elapsed_ms", 0) < SLOWEST_MS
        if code == 0:
            (path,) = result["paths"]
            assert path["answered"] is True
            assert path["label"] == "proxy-nuc1"
            found = labels(path)
            is_full = done_s > FULL[0] and at_s < FULL[1] + USUAL_S
            assert is_one_of(found, STRAIGHT, DETOUR) or (
                # A ping counts the switches, and each hop is asked by a request of its own. Where keepalives are lost,
                # the path changes in between: there are as many hops as on one path, and some are of the other.
                is_full and found[0] == STRAIGHT[0] and {*found} <= {None, *STRAIGHT}
            ), "another path than there is"
        elif code == 1:
            assert not all(each["answered"] for each in result["paths"])
        else:
            assert complaint, "an error without a sentence"
    right = 0
    slowness_s = max(done_s - at_s for (at_s, *_), done_s in zip(seen, ended_s, strict=True))
    for begin_s, end_s, switches in (
        (0, CUT[0], STRAIGHT),
        (CUT[0], CUT[1], DETOUR),
        (CUT[1], KILLED[0], STRAIGHT),
        (KILLED[0] - EARLY_S, KILLED[1], DETOUR),  # until the locations that the RIB at nuc3 gave have run out
        (KILLED[1], FULL[0], STRAIGHT),
        (FULL[1], LASTS_S, STRAIGHT),
    ):
        found = [
            labels(result["paths"][0])
            for (at_s, code, result, _), done_s in zip(seen, ended_s, strict=True)
            if begin_s <= at_s and done_s < end_s and code == 0
        ]
        is_right = switches in found
        right += is_right
        assert is_right or slowness_s > USUAL_S, f"{begin_s} to {end_s} s: no right trace"
    assert right, f"no phase with a right trace; a trace takes {slowness_s:.1f} s"
    assert view.gap_s < 4
    assert changes_of(view, "nuc1", "nuc2")[:2] == ["lost", "up"], view.events
    full = changes_of(view, "nuc3", "nuc4")  # its keepalives may be lost in the queue, or not
    assert full == ["lost", "up"] * (len(full) // 2), view.events
    assert "switch-nuc3 no longer answers" in view.events
    assert "switch-nuc3 answers again" in view.events
    (member,) = summary["members"]
    assert member["sent"] > 0.8 * (LASTS_S - max(slowness_s, USUAL_S)) / PING_S, "ping stopped while it ran"
    assert 0 < member["loss"] < 0.5, "pings over a cut are lost, and those after it come back"
    # A busy machine may miss three keepalives, and a ping is not repeated over the other path.
    assert sum(each["rtt_ms"] is not None for each in pongs[-10:]) >= 8
