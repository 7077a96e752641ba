"""Figures of the uplink bench, from what both ends and the link report.

Sans-I/O. A figure without a message that arrived is left out. Ages are of messages that arrived whole, from when they
were due; ``fraction`` says how many of all that were due those are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from report import percentile

from thin_link.conditions import Conditions
from thin_link.exchange import Tally
from thin_link.line import Used
from thin_link.traffic import Stream, wire_bytes

DUE: Final = "due"
SENT: Final = "sent"
ARRIVED: Final = "arrived whole"
FRACTION: Final = "fraction"
AGE_P50: Final = "age p50, ms"
AGE_P99: Final = "age p99, ms"
OVER_IDLE: Final = "age p99 over idle, ms"
OF_LINK: Final = "of what the link could carry"
STREAM_COLUMNS: Final = (DUE, SENT, ARRIVED, FRACTION, AGE_P50, AGE_P99, OVER_IDLE, OF_LINK)
SHARE: Final = "link share alone"
WHOLE: Final = "camera and lidar, of what the link could carry"
QUEUE_P50: Final = "queue p50, ms"
DROPS: Final = "dropped by queue, %"
SHARE_BOTH: Final = "link share with TCP"
TCP_BOTH: Final = "TCP's share then"
TCP_ALONE: Final = "TCP's share alone"
RELAY_LATE: Final = "relay late p99, ms"
LINK_COLUMNS: Final = (SHARE, WHOLE, QUEUE_P50, DROPS, SHARE_BOTH, TCP_BOTH, RELAY_LATE)


def merged(mix: Sequence[Stream], robot: Mapping[str, Any], cloud: Mapping[str, Any]) -> dict[str, Tally]:
    """Return all streams of a window, as they left one end and arrived at the other.

    An answer is due for each request that was.
    """
    found: dict[str, Tally] = {}
    for each in mix:
        source, sink = (robot, cloud) if each.direction == "up" else (cloud, robot)
        due = robot[each.answers]["due"] if each.answers else source[each.name]["due"]
        found[each.name] = Tally(**{**sink[each.name], "due": due, "sent": source[each.name]["sent"]})
    return found


def stream_figures(
    stream: Stream,
    report: Tally,
    conditions: Conditions,
    mix: Sequence[Stream],
    could_s: Mapping[str, float],
    span_s: float,
) -> dict[str, float]:
    """Return the figures of one stream, by column.

    ``could_s``: messages a second that the uplink could carry whole, by stream. ``span_s``: of the window.
    """
    found: dict[str, float] = {
        DUE: report.due,
        SENT: report.sent,
        ARRIVED: len(report.ages_s),
        FRACTION: len(report.ages_s) / max(report.due, 1),
    }
    if report.ages_s:
        found[AGE_P50] = 1e3 * percentile(report.ages_s, 0.5)
        found[AGE_P99] = 1e3 * percentile(report.ages_s, 0.99)
        found[OVER_IDLE] = found[AGE_P99] - idle_ms(stream, conditions, mix)
    if stream.bulk:
        found[OF_LINK] = len(report.ages_s) / max(span_s * could_s[stream.name], 1.0)
    return found


def idle_ms(stream: Stream, conditions: Conditions, mix: Sequence[Stream]) -> float:
    """Return the age of a message on the idle link: one way, or for an answer both, and its time on the wire."""
    way = conditions.up if stream.direction == "up" else conditions.down
    found = way.delay_ms + wire_bytes(stream.size) * 8e3 / way.bits_s
    asked = next((each for each in mix if each.name == stream.answers), None)
    return found + (idle_ms(asked, conditions, mix) if asked else 0.0)


def whole_share(
    mix: Sequence[Stream], reports: Mapping[str, Tally], could_s: Mapping[str, float], span_s: float
) -> float:
    """Return the bytes of whole bulk messages, of those that the link could carry in a window."""
    bulk = [each for each in mix if each.bulk]
    arrived = sum(len(reports[each.name].ages_s) * wire_bytes(each.size) for each in bulk)
    return arrived / max(sum(could_s[each.name] * wire_bytes(each.size) for each in bulk) * span_s, 1.0)


def link_figures(conditions: Conditions, alone: Used, both: Used | None) -> dict[str, float]:
    """Return the figures of the uplink, alone and with a TCP flow."""
    byte_ms = 8e3 / conditions.up.bits_s
    found = {
        SHARE: alone.up.share,
        DROPS: 100 * alone.up.queue_drops / max(alone.up.offered, 1),
        RELAY_LATE: max(alone.late_ms, both.late_ms if both else 0.0),
    }
    if alone.up.depth_bytes:
        found[QUEUE_P50] = byte_ms * percentile(alone.up.depth_bytes, 0.5)
    if both:
        found[SHARE_BOTH] = both.up.share - both.up.marked_share
        found[TCP_BOTH] = both.up.marked_share
    return found
