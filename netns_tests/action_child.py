"""Proxy node with servers in a child process: an action /fibonacci and a service /switch, until a signal ends it.

python -m netns_tests.action_child NODE

Its graph is in memory, since this machine may have no ROS; bridge, switch and delegations are real.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from gdp.crypto.keys import PublicKey
from gdp.nodes.delegation_store import DelegationStore
from proxy.bridge.bridge import Bridge
from proxy.bridge.context import BridgeContext
from proxy.config.rule import Rule
from proxy.doors.rules import DoorRules
from proxy.endpoints.core.qos import default
from proxy.node.door import door_config
from proxy.node.node import run_node
from tests.proxy.bridge import known
from tests.proxy.doors.fibonacci import FEEDBACK, FIBONACCI, SERVICES, STATUS
from tests.proxy.endpoints.fake import FakeEndpoint, FakeGraph, Publication

STEP_S: Final = 0.3
_TICK_S: Final = 0.05
_CDR: Final = b"\0\1\0\0"
_ID: Final = slice(4, 20)
_SUCCEEDED, _CANCELED = 4, 5
Done = Callable[[bytes | str], None]


@dataclass(slots=True)
class _Goal:
    order: int
    due_s: float
    sequence: list[int] = field(default_factory=lambda: [0, 1])
    status: int = 0  # 0: it is executed
    done: Done | None = None

    @property
    def body(self) -> bytes:
        return struct.pack(f"<I{len(self.sequence)}i", len(self.sequence), *self.sequence)


class Server:
    """Node that serves the action, a step each ``STEP_S`` seconds."""

    def __init__(self, graph: FakeGraph) -> None:
        self._goals: dict[bytes, _Goal] = {}
        for part, ask in (("send_goal", self._accept), ("cancel_goal", self._cancel), ("get_result", self._wait)):
            graph.serve("/server", f"/fibonacci/_action/{part}", SERVICES[part].type_name, ask)
        self._feedback: Publication = graph.publish("/server", "/fibonacci/_action/feedback", FEEDBACK.type_name)
        graph.publish("/server", "/fibonacci/_action/status", STATUS, default(latched=True, depth=1))

    def _accept(self, raw: bytes, done: Done) -> None:
        self._goals[raw[_ID]] = _Goal(struct.unpack_from("<i", raw, 20)[0], time.monotonic() + STEP_S)
        done(_CDR + struct.pack("<B3xiI", 1, 0, 0))

    def _cancel(self, raw: bytes, done: Done) -> None:
        self._goals[raw[_ID]].status = _CANCELED
        done(_CDR + struct.pack("<b3xI", 0, 0))

    def _wait(self, raw: bytes, done: Done) -> None:
        self._goals[raw[_ID]].done = done

    def work(self, now_s: float) -> None:
        """Execute the goals."""
        for goal_id, goal in list(self._goals.items()):
            if goal.status == 0 and now_s >= goal.due_s:
                goal.due_s = now_s + STEP_S
                goal.sequence.append(sum(goal.sequence[-2:]))
                self._feedback.publish(_CDR + goal_id + goal.body)
                goal.status = _SUCCEEDED if len(goal.sequence) > goal.order else 0
            if goal.status and goal.done is not None:
                goal.done(_CDR + struct.pack("<b3x", goal.status) + goal.body)
                del self._goals[goal_id]


def main(node_directory: Path) -> None:
    """Serve until a signal."""
    config, delegations = door_config(node_directory, None, None)
    services = known.services() | {each.type_name: each for each in SERVICES.values()}
    graph = FakeGraph(2, {**known.channels(), FEEDBACK.type_name: FEEDBACK}, services)
    graph.serve("/server", "/switch", known.SET_BOOL, lambda raw, done: done(known.switched("done")))
    endpoint, server = FakeEndpoint(graph, "/bridge"), Server(graph)
    with run_node(config) as node:
        held = DelegationStore(delegations, node.identity)
        owner = PublicKey.from_compressed(next(iter(held)).delegation.subject.owner_key)
        action = Rule.model_validate({"kind": "action", "name": "/fibonacci", "type": FIBONACCI, "owner": owner})
        service = Rule.model_validate({"kind": "service", "name": "/switch", "type": known.SET_BOOL, "owner": owner})
        rules = DoorRules([action, service], [])
        bridge = Bridge(BridgeContext(node.member, node.traffic, node.faults), rules, [endpoint], held)
        node.runtime.watch(endpoint)
        is_ready = False
        while not node.runtime.is_stopped:
            node.runtime.step(time.monotonic() + _TICK_S)
            now_s = time.monotonic()
            server.work(now_s)
            bridge.work(now_s)
            node.member.flush(now_s)
            if not is_ready and node.member.attachment.is_attached and bridge.is_settled:
                is_ready = True
                print(json.dumps({"event": "ready"}), flush=True)
        node.runtime.unwatch(endpoint)


if __name__ == "__main__":
    main(Path(sys.argv[1]).absolute())
