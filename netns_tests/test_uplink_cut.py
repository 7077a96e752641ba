"""Two uplinks over real tunnels: a cut of either delays no message of a topic with two paths, and loses none at all.

A robot with two uplinks, each behind a NAT of its own, has a tunnel over each to one border. A server behind another
NAT reads two topics, one with ``paths: 2``. A cut lets all packets of one uplink vanish, so that only missing
keepalives show it.
"""

from __future__ import annotations

import shutil
import time
from contextlib import ExitStack
from itertools import pairwise
from typing import Literal

import pytest

from gdp.trust.right import Right
from lab.internet.access import Access
from lab.internet.flow import NumberedFlow, open_sessions
from lab.internet.laboratory import Laboratory
from lab.process import until

pytestmark = [
    pytest.mark.netns,
    pytest.mark.nightly,
    pytest.mark.skipif(shutil.which("wireguard-go") is None, reason="wireguard-go is not installed"),
]

UPLINKS = ("wlan0", "wwan0")
TOPICS: dict[str, Literal[1, 2]] = {"one": 1, "two": 2}  # by the number of paths
CUT_S = 2.0
SETTLE_S = 6.0  # between two cuts
PATIENCE_S = 60.0
BEFORE_DETECTION_MS = 180  # three missed keepalives take 210 ms; a busy machine delays some messages by less
SILENT_MS = 300  # at most, over one path


def test_a_cut_of_either_uplink_delays_no_message_over_two_paths_and_loses_none(laboratory: Laboratory) -> None:
    with ExitStack() as stack:
        flows = flows_of(laboratory, stack)
        time.sleep(SETTLE_S)
        cuts = []
        for uplink in UPLINKS:
            site = laboratory.sites[uplink]
            cuts.append(time.monotonic())
            site.cut()
            time.sleep(CUT_S)
            cuts.append(time.monotonic())
            site.restore()
            time.sleep(SETTLE_S)
        for flow in flows.values():
            flow.close()
    spans = list(pairwise(cuts))[::2]
    late = [delay for span in spans for delay in delays_ms(flows[2], *span) if delay > BEFORE_DETECTION_MS]
    assert late == []
    assert max(flows[1].silence_ms(*span) for span in spans) < SILENT_MS
    assert [(flow.lost, flow.doubled) for flow in flows.values()] == [(0, 0)] * 2


def delays_ms(flow: NumberedFlow, from_s: float, to_s: float) -> list[float]:
    """Return the delay of each message that was published in an interval."""
    came = {number: at_s for at_s, number in reversed(flow.arrivals[0])}
    return [(came[number] - at_s) * 1e3 for number, at_s in enumerate(flow.sent_s) if from_s <= at_s < to_s]


def flows_of(laboratory: Laboratory, stack: ExitStack) -> dict[int, NumberedFlow]:
    """Return the two flows by their number of paths, once both have what they asked for."""
    homes = [laboratory.add_site(each, Access.PORT_RESTRICTED) for each in UPLINKS]
    robot = laboratory.add_host("robot", homes[0], UPLINKS[0])
    robot.attach(homes[1], UPLINKS[1])
    rights = [{topic: [right] for topic in TOPICS} for right in (Right.PUBLISH, Right.READ)]
    overlay, server, (sender, reader) = open_sessions(robot, stack, rights, has_direct=False, uplinks=UPLINKS)
    flows: dict[int, NumberedFlow] = {}
    for topic, paths in TOPICS.items():
        subscription = reader.subscribe(topic, paths=paths)
        publisher = sender.publisher(topic, paths=paths)
        publisher.wait_for_readers(timeout_s=PATIENCE_S)
        flows[paths] = NumberedFlow(publisher, subscription)
    # The reader's switch then has two paths for the flow; both use its own uplink.
    until(lambda: overlay.status(server)["counters"]["two_paths"]["shared"] == 1, "a second path", PATIENCE_S)
    return flows
