"""Answer of a proxy to the diagnostic requests ``state``, its flows of one name, and ``mark``.

I/O through the bridge, which it only reads. ``gdp/state/state_answers.py`` says who gets an answer.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from gdp.control.diagnostics import Question
from gdp.crypto.schema import Keyed, text
from gdp.names import ZERO, Name
from gdp.sansio import Timestamps
from gdp.state.state_answers import answer_state
from proxy.bridge.bridge import Bridge
from proxy.node.control_answer import MARK, answer_mark
from proxy.node.proxy_state import ProxyState

if TYPE_CHECKING:
    from gdp.diagnosis.facts import ProxyFacts

_ASKED: Final = Keyed("q", text(256), absent="")


def answer_for_proxy(state: ProxyState, bridge: Bridge) -> None:
    """Answer ``state`` for a proxy.

    The body may have the ROS name that the asker typed (``q``). A member of another domain must state the 256-bit name.
    """
    member, identity, policy = state.member, state.identity, state.policy

    def gather(question: Question, now: Timestamps) -> ProxyFacts:
        from proxy.bridge.name_facts import proxy_facts  # a node gathers facts for who asks

        asked = _ASKED.read(question.body)
        if not asked or question.asker.domain not in policy.diagnostics:
            asked = question.name.to_text() if question.name != ZERO else ""
        return proxy_facts(
            bridge,
            state.context,
            identity,
            asked,
            now,
            waits=state.wait_facts(now.mono_s),
            uptime_s=state.uptime_s(now.mono_s),
            with_known=question.asker.name == identity.name,
            ros_domains=state.ros_domains,
        )

    def holders(name: Name, _now_s: float) -> set[Name]:
        publishers = (each for each in list(member.publications) if each.topic == name)
        readers = {reader for each in publishers for reader in map(Name, each.matched.names())}
        return readers | {each.publisher for each in member.subscriptions.writer_proxies_of(name)}

    answer_state(member.diagnostics, policy, gather, holders)
    member.diagnostics.register(MARK, partial(answer_mark, state))
