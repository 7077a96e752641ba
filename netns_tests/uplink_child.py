"""Participant without ROS in a process of its own: a replica that takes requests, or the robot that calls.

The robot reads commands on standard input, each a line of JSON: ``{"word": ...}``. A number: it prints ``met`` when it
has this many peers. ``go``: it prints ``done`` when all peers have confirmed its requests. ``ask``: the same with
requests to one peer.
"""

from __future__ import annotations

import json
import os
import secrets
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from gdp.client.participant import Participant, Topic
from gdp.control.settings import NodeSettings
from gdp.nodes.delegation_store import DelegationStore
from gdp.nodes.membership import incarnation, wall_clock_ms
from gdp.ports.raw import RawPlane
from gdp.runtime.runtime import Runtime
from gdp.stores.keyring import DELEGATIONS, load_identity, load_root
from gdp.trust.domain import Policy

GAP_S = 0.002  # between requests
PATIENCE_S = 30.0


class Robot:
    """Client that calls on command."""

    def __init__(self, member: Participant, runtime: Runtime, topic: Topic, requests: int, size: int) -> None:
        self._member, self._runtime, self._service = member, runtime, topic.name
        self._requests, self._body = requests, bytes(size)
        self._stream = member.call(topic, b"requests")
        self._stream.queue.bundle_bytes = 0

    def meet(self, peers: int) -> None:
        """Return when it has this many peers."""
        deadline_s = time.monotonic() + PATIENCE_S
        is_met = self._runtime.run(lambda: len(self._member.peers(self._service)) == peers, deadline_s)
        assert is_met, f"{len(self._member.peers(self._service))} peers, not {peers}"

    def publish(self) -> None:
        """Call all peers; return when all have confirmed."""
        for _ in self._paced():
            self._stream.publish(self._body)
        assert self._runtime.run(self._stream.is_acknowledged, time.monotonic() + PATIENCE_S)

    def ask(self) -> None:
        """Call one peer; return when the request has left."""
        server = self._member.peers(self._service)[0]
        for _ in self._paced():
            self._member.send_request(self._service, server, self._body)
        self._runtime.run(lambda: False, time.monotonic() + 0.2)

    def _paced(self) -> Iterator[None]:
        for _ in range(self._requests):
            yield
            self._runtime.run(lambda: False, time.monotonic() + GAP_S)


def main(service: str, identity_at: str, root: str, device: str, role: str, *load: str) -> None:
    """Run the replica (``role`` is ``serve``) or the robot (``call``, then requests and bytes) at a switch's device."""
    identity = load_identity(Path(identity_at), time.time())
    policy = Policy(load_root(Path(root)), [])
    (topic,) = DelegationStore(Path(identity_at) / DELEGATIONS, identity)
    assert topic.name.to_text() == service
    member = Participant(
        identity,
        policy,
        NodeSettings(incarnation=incarnation(), first_sequence=wall_clock_ms(), random_bytes=secrets.token_bytes),
    )
    plane = RawPlane([device])
    runtime = Runtime(member, plane)
    if role == "serve":
        member.serve(topic, b"a replica")
        print("up", flush=True)
        runtime.run(lambda: bool(member.poll_messages() and False))
        return
    robot = Robot(member, runtime, topic, *map(int, load))
    words = os.fdopen(os.dup(sys.stdin.fileno()), "rb", buffering=0)
    heard: list[object] = []
    runtime.watch(words, lambda: heard.append(json.loads(words.readline() or "{}").get("word")))
    print("up", flush=True)
    while runtime.run(lambda: bool(heard)) and (word := heard.pop()):
        if word == "go":
            robot.publish()
        elif word == "ask":
            robot.ask()
        else:
            robot.meet(int(str(word)))
        print("done", flush=True)
