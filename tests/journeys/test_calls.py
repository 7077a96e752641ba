"""Calls of Python that one message costs in the cores of its two ends: a count, so it is the same on every machine."""

from __future__ import annotations

import sys
from cProfile import Profile
from functools import partial
from typing import Any, Final

import pytest

from tests.journeys.flows import ROBOT, SERVER, Flow, flowing, ring

pytestmark = pytest.mark.momentary("calls are counted over 250 messages, not over leases")

MESSAGES: Final = 200
_CORE: Final = frozenset({"receive", "handle_timer", "get_timer", "frames_to_send", "frames_sent"})


class _Counted:
    """A core whose calls from its node are counted."""

    def __init__(self, core: Any, profile: Profile) -> None:
        self._core = core
        self._profile = profile

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._core, name)
        return partial(self._run, found) if name in _CORE else found

    def _run(self, call: Any, *values: Any) -> Any:
        self._profile.enable()
        try:
            return call(*values)
        finally:
            self._profile.disable()


def _calls_of(flow: Flow, size: int) -> float:
    """Return the calls for one message, those of Python's own functions included; keepalives and timers are in them."""
    network, profile = flow.world.network, Profile()
    flow.stream(50, 0.01, size)
    network.run(2)
    for label in (ROBOT, SERVER):
        node = network._nodes[label]
        node.machine = _Counted(node.machine, profile)

    def publish() -> None:
        profile.enable()
        try:
            flow.publisher.publish(bytes(size))
            flow.member.flush(network.now.mono_s)
        finally:
            profile.disable()
        network.send_pending(ROBOT)

    for number in range(MESSAGES):
        network.call(number * 0.01, publish)
    network.run(MESSAGES * 0.01 + 0.5)
    assert flow.has(SERVER, 50 + MESSAGES)
    return float(sum(each.callcount for each in profile.getstats())) / MESSAGES


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="the counts are those of Python 3.11")
@pytest.mark.parametrize(("size", "reliable", "most"), [(100, True, 349), (100, False, 340)])
def test_a_message_costs_no_more_calls_than_before(size: int, reliable: bool, most: int) -> None:
    assert _calls_of(flowing(ring(), reliable=reliable), size) <= most
