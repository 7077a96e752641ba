"""Durations in textual form: ``15h``, ``20min``, ``90s``."""

from __future__ import annotations

import re
from typing import Final

from gdp.errors import LocalError

_UNITS_S: Final = {"d": 86400.0, "h": 3600.0, "min": 60.0, "s": 1.0}


def seconds_from_text(text: str) -> float:
    """Parse one or more numbers with units, larger units first: ``1h30min``, ``0.5h``; a bare number is seconds.

    Raises:
        LocalError: the text is empty or has another form.
    """
    if re.fullmatch(r"\d+(?:\.\d+)?", text):
        return float(text)
    pattern = "".join(rf"(?:(?P<{unit}>\d+(?:\.\d+)?){unit})?" for unit in _UNITS_S)
    match = re.fullmatch(pattern, text)
    if not match or not text:
        raise LocalError(f"{text!r}: expected a span of time such as 15h, 20min, 90s or 1h30min")
    return sum(float(number) * _UNITS_S[unit] for unit, number in match.groupdict().items() if number)


def duration_text(seconds: float) -> str:
    """Return a duration in the largest unit that gives at least one, with at most two decimals."""
    for unit, unit_s in _UNITS_S.items():
        if seconds >= unit_s:
            return f"{round(seconds / unit_s, 2):g}{unit}"
    return f"{seconds:g}s"
