"""Accuracy of a thin link: its rate, delay, loss and FIFO as datagrams find them, compared with what was asked.

I/O. The moments are those of the kernel: sent before the system call, received by SO_TIMESTAMPNS.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any, Final

from peers.process import FailedError
from report import percentile
from testbed import Lab

from thin_link.conditions import FRAME_BYTES, Conditions
from thin_link.line import ADDRESSES, CLOUD, ROBOT, open_line
from thin_link.systems import start_role

__all__ = ["COLUMNS", "DELAY_P50", "DELAY_P99", "FIFO", "LATE", "LOSS", "RATE", "measure_line"]

RATE: Final = "rate / asked"
DELAY_P50: Final = "delay error p50, ms"
DELAY_P99: Final = "delay error p99, ms"
FIFO: Final = "FIFO / asked"
LOSS: Final = "loss - asked, %"
LATE: Final = "relay late p99, ms"
CPU: Final = "relay CPU, share of a core"
COLUMNS: Final = (RATE, DELAY_P50, DELAY_P99, FIFO, LOSS, LATE, CPU)
_READY_S: Final = 10.0
_SILENCE_S: Final = 0.5
_PACED_SHARE: Final = 0.9  # of the rate: the queue stays empty
_OVERLOAD: Final = 1.2


def measure_line(lab: Lab, conditions: Conditions, seconds: float) -> dict[str, float]:
    """Return the figures of the direction from the robot, by column.

    Raises:
        FailedError: a process did not come up, or the relay lost frames itself.
    """
    asked = conditions.up
    frames_s = asked.mean_bits_s / 8 / FRAME_BYTES
    serial_ms = 1e3 / frames_s
    with open_line(lab, conditions) as line:
        line.begin()
        paced = _probe(lab, asked.delay_ms, round(seconds * frames_s * _PACED_SHARE), 1e9 / frames_s / _PACED_SHARE)
        used = line.end()
    errors_ms = [abs(age_ns / 1e6 - asked.delay_ms - serial_ms) for _, age_ns, _ in paced[1]]
    with open_line(lab, conditions) as line:
        depth = max(round(asked.fifo_bytes / FRAME_BYTES), 1)
        over = _probe(lab, asked.delay_ms, round(depth / (1 - 1 / _OVERLOAD) + seconds * frames_s),
                      1e9 / frames_s / _OVERLOAD)  # fmt: skip
    arrived = over[1]
    span_s = (arrived[-1][2] - arrived[0][2]) / 1e9
    lost = 1 - len(paced[1]) / paced[0]
    waited_ms = percentile([age_ns / 1e6 for _, age_ns, _ in arrived], 0.99) - asked.delay_ms
    return {
        RATE: (len(arrived) - 1) / (1 - asked.loss) / span_s / frames_s,
        DELAY_P50: percentile(errors_ms, 0.5),
        DELAY_P99: percentile(errors_ms, 0.99),
        FIFO: waited_ms / serial_ms / depth,
        LOSS: round(100 * (lost - asked.loss), 6),
        LATE: used.late_ms,
        CPU: used.cpu_share,
    }


def _probe(lab: Lab, delay_ms: float, count: int, every_ns: float) -> tuple[int, list[tuple[int, int, int]]]:
    """Send datagrams; return their number, and number, age and arrival of those that came, in order."""
    settings: Mapping[str, Any] = {"address": ADDRESSES[CLOUD], "silence_s": _SILENCE_S + 2 * delay_ms / 1e3}
    with ExitStack() as stack:
        reader = stack.enter_context(start_role(lab, CLOUD, "probe-read", settings))
        reader.read(_READY_S)
        paced = {"address": ADDRESSES[CLOUD], "count": count, "every_ns": round(every_ns)}
        sender = stack.enter_context(start_role(lab, ROBOT, "probe-send", paced))
        sender.read(_READY_S + 2 * count * every_ns / 1e9)
        found = reader.read(2 * _READY_S).get("arrived")
    if not isinstance(found, list) or len(found) < 2:
        raise FailedError("no datagram crossed the link")
    return count, [(int(number), int(age_ns), int(at_ns)) for number, age_ns, at_ns in found]
