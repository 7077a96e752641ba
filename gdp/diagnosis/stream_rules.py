"""Rules about the messages of a name: that they arrive, or that keys, QoS, rates or the path keep them.

Sans-I/O. Each rule yields sentence and command where its cause holds; the first counts.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from typing import Final

from gdp.diagnosis.answer import Cause
from gdp.diagnosis.facts import FlowFact
from gdp.diagnosis.view import Found, Rule, View, short
from gdp.intervals import REPORT_S

_CHECK: Final = "gdp-proxy --config proxy.yaml --check"
_RELOAD: Final = "gdp reload NODE_DIR"


def arrives(view: View) -> Iterator[Found]:
    """Messages come, or servers answer, and nothing is left out."""
    for end in view.importers:
        flow = end.flow
        if flow.kind != "topic" and flow.connected and not _failures(flow.faults):
            text = f"It answers: {flow.connected} server{'s' if flow.connected > 1 else ''} of {flow.local} connected"
            nearest = f"; requests go to {', then '.join(flow.ranking)}" if flow.ranking else ""
            yield f"{text}{nearest}.", ""
        lost = sum(flow.lost.values()) - flow.lost.get("thinned", 0)
        if flow.received and lost <= flow.received // 10 and not flow.odd_qos:
            age = "now" if flow.idle_s is None else f"{flow.idle_s:.2f} s ago"
            window_s = view.facts.window_s
            rate = f", {flow.received / window_s:.3g} Hz" if window_s else ""
            thinned = flow.thinned + sum(far.flow.thinned for far in view.exporters)
            left_out = f"; max_hz leaves out {thinned} of {thinned + flow.received} messages" if thinned else ""
            clauses = f"{left_out}{_own_pace(view, flow)}{_governs(view)}"
            yield f"It arrives {end.place}: last message {age}{rate}{clauses}.", ""
        far = [each.flow for each in view.exporters]
        if flow.full_parts and not (flow.received or lost or any(e.is_throttled or e.lost or e.faults for e in far)):
            yield f"It arrives {end.place}: parts of a message came, which is not complete yet{_governs(view)}.", ""
    for end in view.exporters:
        if end.proxy.is_near and not view.importers and end.flow.is_carried and end.flow.readers:
            if end.flow.kind != "topic":
                yield f"It is served: {end.flow.readers} remote clients of {end.flow.local} connected.", ""
            if end.flow.sent and not any(end.flow.lost.values()):
                left = f"{end.flow.sent} messages to {end.flow.readers} remote readers just now"
                yield f"It leaves: {left}{_governs(view)}.", ""


def idle(view: View) -> Iterator[Found]:
    """Everything stands, and no message was published just now."""
    for end in view.importers:
        flow = end.flow
        if flow.kind == "topic" and flow.live and not flow.received and not _is_sent_now(view):
            if flow.idle_s is None and not _has_published(view):
                continue
            when = "before this reader began" if flow.idle_s is None else f"{flow.idle_s:.3g} s ago"
            yield f"It is connected and idle: the last message came {when}.", ""
    for end in view.exporters:
        flow = end.flow
        if view.importers or not flow.is_carried or not flow.nodes:
            continue
        if flow.kind != "topic" and flow.advertised == "accepted":
            yield f"It is served and idle: {flow.readers} remote clients are connected.", ""
        if flow.kind == "topic" and flow.readers and flow.idle_s is not None and not flow.messages:
            yield f"It is connected and idle: the last message left {flow.idle_s:.3g} s ago.", ""


def key_epoch(view: View) -> Iterator[Found]:
    """The publisher seals under an epoch whose secret the reader lacks."""
    for end in view.importers:
        sealing = {max(far.flow.epochs) for far in view.exporters if far.flow.epochs}
        if end.flow.epochs and sealing and not sealing <= set(end.flow.epochs):
            text = (
                f"The publisher seals under key epoch {max(sealing)}; the"
                f" delegation {end.place} ends with {max(end.flow.epochs)}."
            )
            yield text, _RELOAD
        if end.flow.drops.get("unknown-epoch") or end.flow.drops.get("no-key"):
            yield f"Frames arrive {end.place} under a key epoch that the delegation does not contain.", _RELOAD


def keys_differ(view: View) -> Iterator[Found]:
    """Frames arrive that do not open or verify."""
    for end in view.importers:
        bad = end.flow.drops.get("bad-tag", 0) + end.flow.drops.get("bad-signature", 0)
        if bad and not end.flow.received:
            yield f"Frames arrive {end.place} that do not open: the two ends hold different secrets.", _RELOAD


def qos_impossible(view: View) -> Iterator[Found]:
    """A local reader requests a QoS that no network can promise."""
    for end in view.importers:
        if end.flow.odd_qos:
            text = f"A reader {end.place} matches nothing: {end.flow.odd_qos[0]}."
            yield text, f"ros2 topic info -v {end.flow.local}"


def qos_reliability(view: View) -> Iterator[Found]:
    """A reader requests reliable, its publisher offers best effort, and messages are lost."""
    for end in view.importers:
        wants = any("reliable" in each.split(", ") for each in end.flow.qos)
        if wants and not end.flow.is_reliable and end.flow.lost.get("gap"):
            text = (
                f"The publisher of {end.flow.local} offers best effort, so"
                " lost messages stay lost; its reader asks for reliable."
            )
            yield text, f"ros2 topic info -v {end.flow.local}"


def qos_durability(view: View) -> Iterator[Found]:
    """A reader wants old messages, and its publisher keeps none."""
    for end in view.importers:
        wants = any("transient_local" in each for each in end.flow.qos)
        keeps = any(far.flow.depth for far in view.exporters)
        published = any(far.flow.idle_s is not None and far.flow.idle_s > end.flow.age_s / 2 for far in view.exporters)
        if wants and not keeps and end.flow.idle_s is None and view.exporters and published and end.flow.live:
            text = (
                f"The publisher of {end.flow.local} is volatile: its last"
                " message came before this reader, which wants old ones."
            )
            yield text, f"ros2 topic info -v {view.exporters[0].flow.local}"


def too_large(view: View) -> Iterator[Found]:
    """Messages are above ``max_bytes``."""
    for end in view.ends:
        if end.flow.faults.get("too-large"):
            yield f"Messages do not cross {end.place}: {end.flow.details.get('too-large', 'too large')}.", _CHECK


def not_in_control(view: View) -> Iterator[Found]:
    """Messages come, and none of the publisher that holds the control of the topic."""
    for end in view.importers:
        if end.flow.faults.get("not-in-control") and not end.flow.received:
            text = f"Messages do not pass {end.place}: {end.flow.details.get('not-in-control', 'not in control')}."
            yield text, f"gdp control show {shlex.quote(end.flow.local)}"


def rate_limit(view: View) -> Iterator[Found]:
    """Most messages are left out for ``max_hz``."""
    for end in view.ends:
        flow = end.flow
        passed = flow.received if flow.side == "import" else flow.messages - flow.thinned
        if flow.thinned > passed and flow.max_hz is not None:
            share = 100 * flow.thinned / (flow.thinned + max(passed, 0))
            text = f"The rule's max_hz {flow.max_hz:g} leaves out {share:.0f} % of the messages {end.place}."
            yield text, _CHECK


def bit_rate_limit(view: View) -> Iterator[Found]:
    """Messages wait, or are given up, for ``max_bits_s``."""
    for end in view.exporters:
        flow = end.flow
        if flow.max_bits_s is not None and (flow.is_throttled or sum(flow.lost.values()) > 0):
            text = f"The rule's max_bits_s {flow.max_bits_s:g} is less than what is published {end.place}."
            yield text, _CHECK


def deadline(view: View) -> Iterator[Found]:
    """Best-effort messages could not leave in time."""
    for end in view.exporters:
        if late := end.flow.lost.get("lifespan", 0) + end.flow.lost.get("queue-overflow", 0):
            limit = "" if end.flow.deadline_ms is None else f" of {end.flow.deadline_ms:g} ms"
            text = f"{late} messages could not leave {end.place} within their deadline{limit} and were dropped."
            yield text, _CHECK


def too_fast(view: View) -> Iterator[Found]:
    """Messages come faster than readers confirm them."""
    for end in view.ends:
        if end.flow.faults.get("too-fast") or end.flow.lost.get("window-overflow"):
            yield f"{end.flow.local} is published faster than the path carries it {end.place}.", "gdp top"


def memory_full(view: View) -> Iterator[Found]:
    """The reader has no memory for unfinished messages."""
    for end in view.importers:
        if end.flow.drops.get("memory-full") or end.flow.lost.get("reader-memory"):
            yield f"The proxy {end.place} has no memory left for unfinished messages.", "gdp status NODE_DIR"


def pending_full(view: View) -> Iterator[Found]:
    """A switch has parked too many frames."""
    for switch in view.facts.switches:
        if count := switch.drops.get("pending-full"):
            text = f"{view.place_of(switch)} dropped {count} frames: too many already wait for a RIB's answer."
            yield text[0].upper() + text[1:], "gdp status SWITCH_DIR"


def mtu_hole(view: View) -> Iterator[Found]:
    """Small frames pass, large ones do not."""
    for switch in view.facts.switches:
        if count := switch.drops.get("too-big"):
            text = f"{view.place_of(switch)} dropped {count} frames that are longer than the MTU of the next link."
            yield text[0].upper() + text[1:], f"gdp trace {shlex.quote(view.facts.asked)}"
    for end in view.importers:
        carried = [far.flow for far in view.exporters if far.flow.kind == "topic" and far.flow.is_carried]
        unjoined = [flow for flow in carried if not flow.readers]
        asks = any(each.is_near and each.readers and each.is_joined for each in view.facts.switches)
        if unjoined and asks and end.flow.writers and not end.flow.live:
            text = (
                "The switch here asks for the topic, and its publisher"
                " hears of no reader: short frames pass, long ones do not."
            )
            yield text, f"gdp trace {shlex.quote(view.facts.asked)}"
        sent = [flow for flow in carried if flow.is_unconfirmed]  # what waits there says nothing of any link
        has_come = end.flow.received or end.flow.full_parts
        if sent and end.flow.live and not has_come and not end.flow.drops.get("bad-tag"):
            mtu = sent[0].mtu or 1_500
            text = (
                f"Small frames pass, but none with a message arrives {end.place}: a"
                f" link on the path carries less than the {mtu} bytes that it states."
            )
            yield text, f"gdp trace {shlex.quote(view.facts.asked)}"


def malformed(view: View) -> Iterator[Found]:
    """Messages cannot be read."""
    for end in view.ends:
        for label in ("malformed", "internal", "no-library", "refused"):
            if end.flow.faults.get(label):
                yield f"Messages are dropped {end.place}: {end.flow.details.get(label, label)}.", _CHECK


def path_loses(view: View) -> Iterator[Found]:
    """Messages are lost on the way."""
    for end in view.importers:
        lost = sum(end.flow.lost.values())
        if lost:
            reasons = ", ".join(sorted(end.flow.lost))
            yield (
                f"{lost} of {lost + end.flow.received} messages were lost on the way ({reasons}).",
                (f"gdp trace {shlex.quote(view.facts.asked)}"),
            )


def publisher_silent(view: View) -> Iterator[Found]:
    """A publisher exists, and has published nothing since the proxy began."""
    for end in view.exporters:
        flow = end.flow
        if flow.kind == "topic" and flow.nodes and flow.is_carried and flow.idle_s is None and flow.age_s > REPORT_S:
            text = (
                f"A node {end.place} has a publisher of {flow.local}, but has published nothing for {flow.age_s:.0f} s."
            )
            yield text, f"ros2 topic hz {flow.local}"


def call_failed(view: View) -> Iterator[Found]:
    """Calls fail."""
    for end in view.ends:
        for label in _failures(end.flow.faults):
            yield f"Calls of {end.flow.local} fail {end.place}: {end.flow.details.get(label, label)}.", _CHECK


def _governs(view: View) -> str:
    """Return which of several readers governs the pace of a topic, as a clause; empty: none does, or not known."""
    flow = next((each.flow for each in view.exporters if each.flow.governing), None)
    if flow is None:
        return ""
    path = f"round trip {1e3 * flow.governing_rtt_s:.3g} ms, {flow.governing_bits_s / 1e6:.3g} Mbit/s"
    return f"; the slowest reader, proxy {short(flow.governing)}, governs ({path})"


def _own_pace(view: View, flow: FlowFact) -> str:
    """Return how many messages went to faster readers only, and which switches left them out; empty: none did."""
    if not (thinned := flow.lost.get("thinned", 0)):
        return ""
    places = [view.place_of(switch) for switch in view.facts.switches if switch.drops.get("thinned")]
    at = f", left out at {' and '.join(places)}" if places else ""
    return f"; {thinned} of {thinned + flow.received} messages went to faster readers only{at}"


def _failures(faults: Mapping[str, int]) -> list[str]:
    return [label for label in ("timed-out", "no-server", "refused") if faults.get(label)]


def _is_sent_now(view: View) -> bool:
    return any(far.flow.messages for far in view.exporters)


def _has_published(view: View) -> bool:
    return any(far.flow.idle_s is not None for far in view.exporters)


RULES: Final[dict[Cause, Rule]] = {
    Cause.ARRIVES: arrives,
    Cause.KEY_EPOCH: key_epoch,
    Cause.KEYS_DIFFER: keys_differ,
    Cause.QOS_IMPOSSIBLE: qos_impossible,
    Cause.TOO_LARGE: too_large,
    Cause.NOT_IN_CONTROL: not_in_control,
    Cause.RATE_LIMIT: rate_limit,
    Cause.BIT_RATE_LIMIT: bit_rate_limit,
    Cause.DEADLINE: deadline,
    Cause.QOS_RELIABILITY: qos_reliability,
    Cause.QOS_DURABILITY: qos_durability,
    Cause.PENDING_FULL: pending_full,
    Cause.MEMORY_FULL: memory_full,
    Cause.TOO_FAST: too_fast,
    Cause.MTU_HOLE: mtu_hole,
    Cause.MALFORMED: malformed,
    Cause.CALL_FAILED: call_failed,
    Cause.PATH_LOSES: path_loses,
    Cause.PUBLISHER_SILENT: publisher_silent,
    Cause.IDLE: idle,
}
