"""Participant without ROS in a process of its own: a replica that takes requests, or the robot that calls.

The robot reads commands on standard input, each a line of JSON: ``{"word": ...}``. A number: it prints ``met`` when it
has this many peers. ``go``: it prints ``done`` when all peers have confirmed its requests.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

from gdp.client.participant import Topic
from gdp.config.schema import Domain
from lab.end import End

GAP_S = 0.002  # between requests
PATIENCE_S = 30.0


class Robot:
    """Client that calls on command."""

    def __init__(self, end: End, topic: Topic, requests: int, size: int) -> None:
        self._member, self._runtime, self._service = end.member, end.runtime, topic.name
        self._requests, self._body = requests, bytes(size)
        self._stream = end.member.call(topic, b"requests")
        self._stream.queue.bundle_bytes = 0

    def meet(self, peers: int) -> None:
        """Return when it has this many peers."""
        deadline_s = time.monotonic() + PATIENCE_S
        is_met = self._runtime.run(lambda: len(self._member.services.peers(self._service)) == peers, deadline_s)
        assert is_met, f"{len(self._member.services.peers(self._service))} peers, not {peers}"

    def publish(self) -> None:
        """Call all peers; return when all have confirmed."""
        for _ in range(self._requests):
            self._stream.publish(self._body)
            self._runtime.run(lambda: False, time.monotonic() + GAP_S)
        assert self._runtime.run(self._stream.is_acknowledged, time.monotonic() + PATIENCE_S)


def main(service: str, identity_at: str, root: str, device: str, role: str, *load: str) -> None:
    """Run the replica (``role`` is ``serve``) or the robot (``call``, then requests and bytes) at a switch's device."""
    end = End(Path(identity_at), Domain(root=Path(root)), device)
    (topic,) = end.topics.values()
    assert topic.name.to_text() == service
    if role == "serve":
        end.member.serve(topic, b"a replica")
        print("up", flush=True)
        end.runtime.run(lambda: bool(end.member.poll_messages() and False))
        return
    robot = Robot(end, topic, *map(int, load))
    words = os.fdopen(os.dup(sys.stdin.fileno()), "rb", buffering=0)
    heard: list[object] = []
    end.runtime.watch(words, lambda: heard.append(json.loads(words.readline() or "{}").get("word")))
    print("up", flush=True)
    while end.runtime.run(lambda: bool(heard)) and (word := heard.pop()):
        if word == "go":
            robot.publish()
        else:
            robot.meet(int(str(word)))
        print("done", flush=True)
