"""A machine that is removed from its domain is out within a second: tunnels at the border, and frames at its peers."""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
import time

import pytest

import gdp
from gdp.trust.right import Right
from internet_demo.scenario import Stage
from lab.internet.laboratory import Laboratory
from lab.process import until

pytestmark = [
    pytest.mark.netns,
    pytest.mark.momentary("about a removal, no lease matters"),
    pytest.mark.skipif(
        shutil.which("wireguard-go") is None or not os.access("/dev/net/tun", os.R_OK | os.W_OK),
        reason="needs wireguard-go and /dev/net/tun",
    ),
]

PATIENCE_S = 60.0
CLOSES_S = 1.0
PERIOD_S = 0.01
TOPIC = "/camera/image"


class Flow:
    """Messages from one session to another, with the second at which each arrived; over at ``stop``."""

    def __init__(self, sender: gdp.Session, reader: gdp.Session) -> None:
        self.arrivals: list[float] = []
        self._over = threading.Event()
        self._subscription = reader.subscribe(TOPIC)
        publisher = sender.publisher(TOPIC)
        publisher.wait_for_readers(timeout_s=PATIENCE_S)

        def publish() -> None:
            with contextlib.suppress(gdp.SessionError):  # its queue is full once no reader confirms
                while not self._over.wait(PERIOD_S):
                    publisher.put(b"image")

        self._threads = [
            threading.Thread(target=publish, daemon=True),
            threading.Thread(target=self._read, daemon=True),
        ]
        for each in self._threads:
            each.start()

    def stop(self) -> None:
        """Publish and read no more."""
        self._over.set()
        for each in self._threads:
            each.join(PATIENCE_S)

    def _read(self) -> None:
        while not self._over.is_set():
            with contextlib.suppress(gdp.SessionError):  # nothing came
                self._subscription.receive(timeout_s=0.2)
                self.arrivals.append(time.monotonic())


@pytest.mark.nightly
def test_a_removed_machine_has_no_tunnel_and_no_frame_passes_a_second_later(laboratory: Laboratory) -> None:
    stage = Stage(laboratory, 0.0)
    with contextlib.ExitStack() as stack:
        tokens = [stage.create_domain()]
        stage.start(stage.cloud_b)
        tokens.append(stage.make_token())
        for host, token in zip((stage.robot, stage.cloud_a), tokens, strict=True):
            stage.join(host, token)
            stage.start(host)
        stage.wait_until_joined()
        stage.grant({"robot": {TOPIC: [Right.PUBLISH]}, "cloud-a": {TOPIC: [Right.READ]}})
        sessions = [stack.enter_context(stage.open_session(stage.machines[label])) for label in ("robot", "cloud-a")]
        flow = Flow(*sessions)
        stack.callback(flow.stop)
        border = stage.machines["cloud-b"]
        until(lambda: any(each.is_direct for each in stage.links(stage.machines["robot"])))
        until(lambda: len(flow.arrivals) > 100)
        stage.remove("robot")
        removed_s = time.monotonic()
        until(lambda: "robot" not in {each.peer for each in stage.links(border)}, patience_s=CLOSES_S)
        time.sleep(2 * CLOSES_S)
        assert max(flow.arrivals) < removed_s + CLOSES_S
        assert "robot" not in {each.peer for each in (*stage.links(border), *stage.links(stage.machines["cloud-a"]))}
        until(lambda: not stage.links(stage.machines["robot"]))
