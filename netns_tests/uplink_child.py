"""Participant without ROS in a process of its own: a replica that takes requests, or the robot that calls.

The robot reads commands on standard input, each a line of JSON: ``{"word": ...}``. A number: it prints ``done`` when it
has this many peers. ``go``: when all peers have confirmed its requests.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

from gdp.config.schema import Domain
from lab.end import End

GAP_S = 0.002  # between requests
PATIENCE_S = 30.0


def main(identity_at: str, root: str, device: str, role: str, *load: str) -> None:
    """Run the replica (``role`` is ``serve``) or the robot (``call``, then requests and bytes) at a switch's device."""
    end = End(Path(identity_at), Domain(root=Path(root)), device)
    (service,) = end.topics
    if role == "serve":
        end.serve(service)
        print("up", flush=True)
        end.runtime.run(lambda: bool(end.member.poll_messages() and False))
        return
    count, size = map(int, load)
    stream = end.call(service)
    stream.queue.bundle_bytes = 0
    words = os.fdopen(os.dup(sys.stdin.fileno()), "rb", buffering=0)
    heard: list[object] = []
    end.runtime.watch(words, lambda: heard.append(json.loads(words.readline() or "{}").get("word")))
    print("up", flush=True)
    while end.runtime.run(lambda: bool(heard)) and (word := heard.pop()):
        if word == "go":
            for _ in range(count):
                stream.publish(bytes(size))
                end.runtime.run(lambda: False, time.monotonic() + GAP_S)
            assert end.runtime.run(stream.is_acknowledged, time.monotonic() + PATIENCE_S)
        else:
            deadline_s = time.monotonic() + PATIENCE_S
            assert end.runtime.run(lambda: len(_peers(end, service)) == word, deadline_s), _peers(end, service)
        print("done", flush=True)


def _peers(end: End, service: str) -> list[object]:
    return list(end.member.services.peers(end.name_of(service)))
