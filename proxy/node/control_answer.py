"""Answers of a proxy: to ``control``, who holds the control of a topic, and who is to hold it; to ``mark``, an event.

I/O: it logs. A publisher of the topic may take control: this proxy has verified its right with its advertisement. The
holder may give it, and so may this node itself. Who asks signs, and states the generation of control that it has seen:
so no request is valid twice, nor after a change.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Final

from gdp.control.diagnostics import Question
from gdp.control.topic_control import ACT, ASK, AT, FORCE, GIVE, SEEN, SHOW, TAKE, TO
from gdp.crypto.schema import Keyed, text
from gdp.errors import LocalError, StoreError
from gdp.limits import MARK_MAX_CHARS
from gdp.names import Name
from gdp.sansio import Timestamps
from proxy.bridge.bridge import Bridge
from proxy.bridge.core.exclusive_control import ExclusiveControl
from proxy.bridge.faults import Fault
from proxy.bridge.flow_rows import control_row
from proxy.bridge.imported_topic import ImportedTopic
from proxy.node.proxy_state import ProxyState

log = logging.getLogger(__name__)

MARK: Final = "mark"
_NAME: Final = Keyed("mark", text(MARK_MAX_CHARS))


def answer_control(state: ProxyState, bridge: Bridge) -> None:
    """Answer ``control`` for a proxy."""

    def answer(question: Question, now: Timestamps) -> Mapping[str, object]:
        found, asker = bridge.controlled(question.name), question.asker
        if found is None or (asker.domain not in state.policy.diagnostics and asker.name not in found[0].publishers):
            return {}
        flow, control = found
        error = ""
        if (act := ACT.read(question.body)) != SHOW:
            try:
                _act(act, flow, control, question, now.mono_s, state.identity.name)
            except LocalError as refused:
                error = str(refused)
            else:
                state.context.faults.clear(flow.stats.topic, Fault.NOT_IN_CONTROL)
                holder = "none" if control.holder is None else control.holder.short
                log.info("control name=%s holder=%s asked_by=%s", question.name.short, holder, asker.name.short)
        return {**control_row(flow, control, now.mono_s), "generation": control.generation, "error": error}

    state.member.diagnostics.register(ASK, answer, for_foreign=True)


def answer_mark(state: ProxyState, question: Question, now: Timestamps) -> Mapping[str, object]:
    """Mark an event, for this node itself."""
    keeper = state.context.keeper
    if question.asker.name != state.identity.name or keeper is None:
        return {}
    try:
        return {"topics": keeper.mark(_NAME.read(question.body), now.unix_s)}
    except StoreError as error:
        return {"error": str(error)}


def _act(act: str, flow: ImportedTopic, control: ExclusiveControl, question: Question, now_s: float, own: Name) -> None:
    """Take or give control, where the asker may. Raises ``LocalError``: it may not."""
    asker, body = question.asker.name, question.body
    if SEEN.read(body) != control.generation:
        raise LocalError("control has changed meanwhile; look who holds it, and ask again")
    if act == TAKE:
        if asker not in flow.publishers:
            raise LocalError("only a publisher of the topic may take its control, and none of this node is known here")
        control.take(asker, now_s, since_ns=AT.read(body), force=FORCE.read(body))
    elif act == GIVE:
        if asker not in (control.holder, own):
            raise LocalError("only who holds control may give it; take it with 'gdp control take'")
        control.give(_publisher(flow, TO.read(body)), now_s)
    else:
        raise LocalError("control may be shown, taken or given; this version knows no more")


def _publisher(flow: ImportedTopic, label: str) -> Name | None:
    """Return the publisher of a label; None: the label is empty."""
    found = [name for name, its in flow.publishers.items() if label == its]
    if label and len(found) != 1:
        word = "several publishers have" if found else "no publisher of this topic has"
        raise LocalError(f"{word} the label {label}; known: {', '.join(sorted(flow.publishers.values())) or 'none'}")
    return found[0] if label else None
