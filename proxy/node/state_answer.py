"""Answer of a proxy to the diagnostic request ``state``: its flows of one name.

I/O through the bridge, which it only reads. ``gdp/state/state_answers.py`` says who gets an answer.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from gdp.control.diagnostics import Question
from gdp.crypto.identity import Identity
from gdp.diagnosis.facts import ProxyFacts, WaitFact
from gdp.names import ZERO, Name
from gdp.sansio import Timestamps
from gdp.state.state_answers import answer_state
from gdp.trust.domain import Policy
from proxy.bridge.bridge import Bridge
from proxy.bridge.context import BridgeContext
from proxy.bridge.name_facts import proxy_facts

__all__ = ["answer_for_proxy"]

_ASKED_MAX_CHARS: Final = 256


def answer_for_proxy(
    bridge: Bridge,
    context: BridgeContext,
    identity: Identity,
    policy: Policy,
    waits: Callable[[float], tuple[WaitFact, ...]],
    ros_domains: tuple[int, ...] = (),
) -> None:
    """Answer ``state`` for a proxy.

    The body may have the ROS name that the asker typed (``q``). A member of another domain must state the 256-bit name.
    """
    member, begun_s = context.member, time.monotonic()

    def gather(question: Question, now: Timestamps) -> ProxyFacts:
        asked = question.body.text("q", _ASKED_MAX_CHARS) if "q" in question.body else ""
        if not asked or question.asker.domain not in policy.diagnostics:
            asked = question.name.to_text() if question.name != ZERO else ""
        return proxy_facts(
            bridge,
            context,
            identity,
            asked,
            now,
            waits=waits(now.mono_s),
            uptime_s=max(now.mono_s - begun_s, 0.0),
            with_known=question.asker.name == identity.name,
            ros_domains=ros_domains,
        )

    def holders(name: Name, _now_s: float) -> set[Name]:
        publishers = (each for each in member.publishers() if each.topic == name)
        readers = {reader for each in publishers for reader in map(Name, each.matched.names())}
        return readers | {each.publisher for each in member.writer_proxies_of(name)}

    answer_state(member.diagnostics, policy, gather, holders)
