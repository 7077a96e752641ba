"""Scaling policy of a cluster: between which numbers of machines it moves, by load, by schedule and within a budget.

Sans-I/O; times are arguments, seconds since 1970. Days and hours of a schedule are UTC.
Source: Kubernetes, Horizontal Pod Autoscaling, "Algorithm details": ratio of measured to target value, a tolerance, and
a window over which the highest recommendation holds before machines are taken away.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Final, NamedTuple, TypeAlias

from gdp.errors import LocalError

MACHINES_MAX: Final = 1_000
WINDOW_S: Final = 30.0  # over which load is measured
_DOWN_S: Final = 300.0  # the highest recommendation of so long holds
_TOLERANCE: Final = 0.1
_DAYS: Final = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_KEYS: Final = ("min", "max", "target_ms", "target_calls_per_s", "schedule", "budget_usd_per_h")
_WINDOW_KEYS: Final = ("days", "from", "to", "min")
Keys: TypeAlias = "Mapping[str, object]"


class CallCounts(NamedTuple):
    """Totals of the robots' proxies since their start.

    Args:
        ended: calls that got an answer.
        total_ms: what they took together, in milliseconds.
    """

    ended: int
    total_ms: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleWindow:
    """Hours of a week with a minimum of their own.

    Args:
        days: numbers, Monday is 0.
        from_minute, to_minute: of the day in UTC; a window that ends before it begins lasts past midnight.
    """

    days: tuple[int, ...]
    from_minute: int
    to_minute: int
    min_machines: int

    def covers(self, unix_s: float) -> bool:
        """Return whether the window is open."""
        now = datetime.fromtimestamp(unix_s, timezone.utc)
        minute, day = 60 * now.hour + now.minute, now.weekday()
        if self.from_minute < self.to_minute:
            return day in self.days and self.from_minute <= minute < self.to_minute
        if minute >= self.from_minute:
            return day in self.days
        return minute < self.to_minute and (day - 1) % 7 in self.days


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalingPolicy:
    """Bounds and target of a cluster's number of machines.

    Args:
        target_ms: mean time of a call that more machines are to keep; None: it does not count.
        target_calls_per_s: calls a second that one machine is to get; None: it does not count.
        budget_usd_per_h: most that all machines may cost in an hour together; None: no limit.
    """

    min_machines: int
    max_machines: int
    target_ms: float | None = None
    target_calls_per_s: float | None = None
    schedule: tuple[ScaleWindow, ...] = ()
    budget_usd_per_h: float | None = None

    def least(self, unix_s: float) -> int:
        """Return the minimum of this moment."""
        open_ = (each.min_machines for each in self.schedule if each.covers(unix_s))
        return min(max([self.min_machines, *open_]), self.max_machines)

    def to_keys(self) -> dict[str, object]:
        """Return the map that ``policy_from_keys`` reads."""
        windows = [
            {
                "days": [_DAYS[day] for day in each.days],
                "from": _clock(each.from_minute),
                "to": _clock(each.to_minute),
                "min": each.min_machines,
            }
            for each in self.schedule
        ]
        keys: dict[str, object] = {
            "min": self.min_machines,
            "max": self.max_machines,
            "target_ms": self.target_ms,
            "target_calls_per_s": self.target_calls_per_s,
            "schedule": windows,
            "budget_usd_per_h": self.budget_usd_per_h,
        }
        return {key: value for key, value in keys.items() if value not in (None, [])}


class Autoscaler:
    """Number of machines of one cluster; one for each cluster, as long as its supervisor runs."""

    def __init__(self, policy: ScalingPolicy) -> None:
        self.policy = policy
        self._samples: deque[tuple[float, CallCounts]] = deque()
        self._recommended: deque[tuple[float, int]] = deque()
        self.reason = ""

    def observe(self, counts: CallCounts | None, now_s: float) -> None:
        """Take the totals of all proxies; None: they are unknown, and what was measured before no longer counts."""
        if counts is None or (self._samples and counts.ended < self._samples[-1][1].ended):  # a proxy began again
            self._samples.clear()
        if counts is not None:
            self._samples.append((now_s, counts))
        while len(self._samples) > 1 and now_s - self._samples[1][0] >= WINDOW_S:
            self._samples.popleft()

    def decide(self, machines: int, usd_per_hour: float | None, now_s: float) -> int:
        """Return how many machines the cluster is to have; ``reason`` says why.

        Args:
            machines: how many it is to have now, at least 1.
            usd_per_hour: price of one machine; None: unknown.
        """
        policy = self.policy
        by_load, self.reason = self._by_load(machines)
        least = policy.least(now_s)
        wanted = min(max(by_load, least), policy.max_machines)
        if wanted > by_load:
            self.reason = f"at least {least} at this time"
        elif wanted < by_load:
            self.reason += f"; at most {policy.max_machines}"
        self._recommended.append((now_s, wanted))
        while now_s - self._recommended[0][0] > _DOWN_S:
            self._recommended.popleft()
        steady = min(max(count for _, count in self._recommended), max(machines, wanted))
        if policy.budget_usd_per_h is not None and usd_per_hour is None:
            self.reason = "the price of a machine is not known before the first one"
            return 1
        if policy.budget_usd_per_h is not None and usd_per_hour:
            affordable = max(int(policy.budget_usd_per_h / usd_per_hour + 1e-9), 1)
            if steady > affordable:
                self.reason = f"{policy.budget_usd_per_h:g} USD an hour pay for {affordable}"
                return affordable
        return steady

    def _by_load(self, machines: int) -> tuple[int, str]:
        """Return the number that the measured load needs, and why; unchanged while it is unknown."""
        policy = self.policy
        if policy.target_ms is None and policy.target_calls_per_s is None:
            return policy.min_machines, "by the schedule"
        if len(self._samples) < 2 or self._samples[-1][0] - self._samples[0][0] < WINDOW_S / 3:
            return machines, "the load is not known"
        (begun_s, before), (ended_s, after) = self._samples[0], self._samples[-1]
        calls, took_ms = after.ended - before.ended, after.total_ms - before.total_ms
        rate = calls / (ended_s - begun_s)
        needed, reason = 1, f"{rate:.1f} calls/s"
        if policy.target_calls_per_s is not None:
            needed = _ratio(machines, rate / machines, policy.target_calls_per_s)
        if policy.target_ms is not None and calls:
            mean_ms = took_ms / calls
            by_time = min(_ratio(machines, mean_ms, policy.target_ms), 2 * machines)
            if by_time > needed:
                needed, reason = by_time, f"{mean_ms:.0f} ms a call"
        return max(needed, 1), reason


def policy_from_keys(keys: Keys) -> ScalingPolicy:
    """Return the policy that ``scale`` of a launch file states.

    Raises:
        LocalError: a key is unknown or out of bounds; the text names it.
    """
    _known("scale", keys, _KEYS)
    least = _count("scale: min", keys.get("min", 1))
    most = _count("scale: max", keys.get("max"))
    if least > most:
        raise LocalError(f"scale: min {least} is above max {most}")
    schedule = keys.get("schedule", [])
    if not isinstance(schedule, Sequence) or isinstance(schedule, str):
        raise LocalError("scale: schedule: expected a list of maps with days, from, to and min")
    return ScalingPolicy(
        min_machines=least,
        max_machines=most,
        target_ms=_positive("target_ms", keys),
        target_calls_per_s=_positive("target_calls_per_s", keys),
        schedule=tuple(_window(each) for each in schedule),
        budget_usd_per_h=_positive("budget_usd_per_h", keys),
    )


def _window(keys: object) -> ScaleWindow:
    if not isinstance(keys, Mapping):
        raise LocalError(
            f"scale: schedule: expected a map such as {{'from': '08:00', 'to': '18:00', 'min': 3}}: {keys}"
        )
    _known("scale: schedule", keys, _WINDOW_KEYS)
    begin, end = _minute("from", keys.get("from")), _minute("to", keys.get("to"))
    if begin == end:
        raise LocalError("scale: schedule: from and to are the same")
    days = _days(keys.get("days", "mon-sun"))
    return ScaleWindow(
        days=days, from_minute=begin, to_minute=end, min_machines=_count("scale: schedule: min", keys.get("min"))
    )


def _days(value: object) -> tuple[int, ...]:
    """Read ``mon-fri``, ``sat`` or a list of days."""
    words = value if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    days: set[int] = set()
    for word in words:
        first, dash, last = str(word).partition("-")
        if first not in _DAYS or (dash and last not in _DAYS):
            raise LocalError(f"scale: schedule: days {word!r}: expected such as mon-fri, or a list: [sat, sun]")
        begin = _DAYS.index(first)
        days |= {(begin + step) % 7 for step in range(((_DAYS.index(last) - begin) % 7 if dash else 0) + 1)}
    return tuple(sorted(days))


def _minute(key: str, value: object) -> int:
    match = re.fullmatch(r"([01]\d|2[0-4]):([0-5]\d)", str(value))
    if match is None or (minute := 60 * int(match[1]) + int(match[2])) > 24 * 60:
        raise LocalError(f"scale: schedule: {key} {value!r}: expected a time in UTC such as 08:00")
    return minute


def _clock(minute: int) -> str:
    return f"{minute // 60:02}:{minute % 60:02}"


def _known(where: str, keys: Keys, known: Sequence[str]) -> None:
    if unknown := sorted(map(str, keys.keys() - set(known))):
        raise LocalError(f"{where}: {', '.join(unknown)}: unknown; expected some of {', '.join(known)}")


def _count(where: str, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MACHINES_MAX:
        raise LocalError(f"{where}: expected a whole number from 1 to {MACHINES_MAX}, not {value!r}")
    return value


def _positive(key: str, keys: Keys) -> float | None:
    value = keys.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise LocalError(f"scale: {key}: expected a number above 0, not {value!r}")
    return float(value)


def _ratio(machines: int, measured: float, target: float) -> int:
    """Return the number of machines at which the measured value per machine would be the target."""
    ratio = measured / target
    return machines if abs(ratio - 1) <= _TOLERANCE else math.ceil(machines * ratio)
