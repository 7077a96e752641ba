"""Calls of Python that one message costs in the cores of its two ends: a count, so it is the same on every machine."""

from __future__ import annotations

import hashlib
import random
import sys
from cProfile import Profile
from functools import partial
from typing import Any, Final

import pytest

from gdp import burst
from gdp.burst import slots
from gdp.burst.cipher import MessageCipher, Plaintext
from tests.journeys.flows import ROBOT, SERVER, Flow, flowing, ring

pytestmark = pytest.mark.momentary("calls are counted over 250 messages, not over leases")

MESSAGES: Final = 200
_TWINS: Final = {
    "CIPHER": MessageCipher, "PLAINTEXT": Plaintext, "DIGEST": hashlib.sha256,
    "received": slots.received, "samples": slots.samples,
}  # fmt: skip
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


def _is_of_bed(code: Any) -> bool:
    """Return whether a function is the profiler's, or of the test bed, which draws randomness and tells the time."""
    if isinstance(code, str):
        return "_lsprof" in code or "_random" in code
    return "/scripts/lab/" in code.co_filename or code.co_filename == random.__file__


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
    return float(sum(each.callcount for each in profile.getstats() if not _is_of_bed(each.code))) / MESSAGES


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="the counts are those of Python 3.11")
@pytest.mark.parametrize("twins", ["Python", "compiled"])
@pytest.mark.parametrize(("reliable", "most"), [(True, 350), (False, 343)])
def test_a_message_of_100_bytes_costs_no_more_calls_than_before(
    reliable: bool, most: int, twins: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if twins == "Python":
        for name, twin in _TWINS.items():
            monkeypatch.setattr(burst, name, twin)
    elif burst.VARIANT == "Python":
        pytest.skip("the compiled twins are not built (scripts/setup.sh does it where a compiler is)")
    most -= 15 if twins == "compiled" else 0
    assert _calls_of(flowing(ring(), reliable=reliable), 100) <= most
