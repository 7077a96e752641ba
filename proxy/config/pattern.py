"""Full ROS names, and patterns of them.

Place: pure. In a pattern ``*`` stands for any characters of one segment, and ``**``, which is a segment of its own, for
one or more segments. As in a shell, neither begins a hidden segment (``/fold/_action/status``): that is written out.
Source: https://design.ros2.org/articles/topic_and_service_names.html; http://wiki.ros.org/Names, by which a segment may
begin with a digit, too.
"""

from __future__ import annotations

import functools
import re
from typing import Final

__all__ = ["NAME_FORM", "NAME_MAX_CHARS", "PATTERN_FORM", "is_name", "is_pattern", "matches"]

NAME_MAX_CHARS: Final = 512
NAME_FORM: Final = r"(?:/[A-Za-z0-9_]+)+"
PATTERN_FORM: Final = r"(?:/(?:\*\*|\*|\*?[A-Za-z0-9_]+(?:\*[A-Za-z0-9_]+)*\*?))+"  # names, too; as ECMAScript reads it

_VISIBLE: Final = "(?!_)[A-Za-z0-9_]+"


def is_name(text: str) -> bool:
    """Return whether this is one full name, such as ``/camera/image``."""
    return len(text) <= NAME_MAX_CHARS and re.fullmatch(NAME_FORM, text) is not None


def is_pattern(text: str) -> bool:
    """Return whether this is a pattern of full names, such as ``/camera/**``; a name is none."""
    return "*" in text and len(text) <= NAME_MAX_CHARS and re.fullmatch(PATTERN_FORM, text) is not None


def matches(pattern: str, name: str) -> bool:
    """Return whether a full name is one that the pattern means."""
    return _compiled(pattern).fullmatch(name) is not None


@functools.lru_cache(maxsize=1024)
def _compiled(pattern: str) -> re.Pattern[str]:
    return re.compile("".join(map(_segment, pattern.split("/")[1:])))


def _segment(text: str) -> str:
    if text == "**":
        return f"(?:/{_VISIBLE})+"
    if text == "*":
        return f"/{_VISIBLE}"
    return "/" + ("(?!_)" if text[0] == "*" else "") + text.replace("*", "[A-Za-z0-9_]*")
