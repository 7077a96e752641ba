"""Full ROS names, patterns of them, and the types of topics, services, actions and nodes.

Sans-I/O. In a pattern ``*`` matches any characters of one segment. ``**``, which is a segment of its own, matches one
or more segments. As in a Unix shell, neither matches the start of a hidden segment (``/fold/_action/status``): a
pattern spells it out. What every node has (``/rosout``, services for parameters) stays out alike (``leaves_out``).
Source: https://design.ros2.org/articles/topic_and_service_names.html; http://wiki.ros.org/Names, by which a segment may
also begin with a digit.
"""

from __future__ import annotations

import functools
import re
from typing import Final, Literal, TypeAlias

Interface: TypeAlias = Literal["topic", "service", "action"]
Kind: TypeAlias = Literal["topic", "service", "action", "node"]

NODE_TYPE: Final = "gdp/Node"  # of every node: what its 256-bit name digests
ACTION_INFIX: Final = "/_action/"  # between an action's name and its parts; ROS 2 design article on actions
NAME_MAX_CHARS: Final = 512
NAME_FORM: Final = r"(?:/[A-Za-z0-9_]+)+"
PREFIX_FORM: Final = r"(?:[A-Za-z0-9_]+(?:/[A-Za-z0-9_]+)*)?"  # a namespace without its first slash; empty: the root
# matches names, too; in ECMAScript's syntax
PATTERN_FORM: Final = r"(?:/(?:\*\*|\*|\*?[A-Za-z0-9_]+(?:\*[A-Za-z0-9_]+)*\*?))+"

_WORD: Final = "[A-Za-z][A-Za-z0-9_]*"
TYPE_FORMS: Final[dict[Kind, tuple[str, str]]] = {  # pattern in ECMAScript's syntax, and an example
    # A service's events and an action's feedback are topics as well.
    "topic": (f"{_WORD}/(?:msg/{_WORD}|srv/{_WORD}_Event|action/{_WORD}_FeedbackMessage)", "sensor_msgs/msg/Image"),
    "service": (f"{_WORD}/srv/{_WORD}", "std_srvs/srv/SetBool"),
    "action": (f"{_WORD}/action/{_WORD}", "test_msgs/action/Fibonacci"),
    "node": (NODE_TYPE, NODE_TYPE),
}
_OF_EVERY_NODE: Final[dict[Kind, frozenset[str]]] = {  # of ROS 2's nodes and ROS 1's
    "topic": frozenset({"/rosout", "/rosout_agg", "/parameter_events"}),
    "service": frozenset(  # the last segment; the others are the node's name
        {
            "describe_parameters", "get_parameter_types", "get_parameters", "list_parameters", "set_parameters",
            "set_parameters_atomically", "get_type_description", "get_loggers", "set_logger_level",
        }
    ),
    "action": frozenset(),
    "node": frozenset(),
}  # fmt: skip
_ANY: Final = "[A-Za-z0-9_]+"
_VISIBLE: Final = f"(?!_){_ANY}"


def is_name(text: str) -> bool:
    """Return whether the text is one full name, such as ``/camera/image``."""
    return len(text) <= NAME_MAX_CHARS and re.fullmatch(NAME_FORM, text) is not None


def resolved(text: str) -> str:
    """Return the full name of a name that is relative to the root namespace, as ROS resolves it; others are kept."""
    return text if text.startswith(("/", "~")) else f"/{text}"


def prefixed(prefix: str | None, name: str) -> str:
    """Return a name, or a pattern, within a namespace; without one it is kept."""
    return f"/{prefix}{name}" if prefix else name


def unprefixed(prefix: str | None, name: str) -> str | None:
    """Return the name without its namespace; None: it lies outside of it."""
    if not prefix:
        return name
    return name.removeprefix(f"/{prefix}") if name.startswith(f"/{prefix}/") else None


def is_pattern(text: str) -> bool:
    """Return whether the text is a pattern of full names, such as ``/camera/**``; a name is not."""
    return "*" in text and len(text) <= NAME_MAX_CHARS and re.fullmatch(PATTERN_FORM, text) is not None


def matches(pattern: str, name: str) -> bool:
    """Return whether a full name matches the pattern."""
    return _compiled(pattern).fullmatch(name) is not None


def meets(pattern: str, name: str) -> bool:
    """Return whether a name is meant by a pattern, or another pattern and it mean names in common, as far as seen."""
    some, other = (each.replace("**", "*").replace("*", "n") for each in (pattern, name))
    return pattern == name or matches(pattern, other) or (is_pattern(name) and matches(name, some))


def is_of_every_node(kind: Kind, name: str) -> bool:
    """Return whether every node has this topic or a service of this last segment, without its author's doing."""
    return (name if kind == "topic" else name.rpartition("/")[2]) in _OF_EVERY_NODE[kind]


def leaves_out(pattern: str, kind: Kind, name: str) -> bool:
    """Return whether a pattern that matches leaves a live name out: every node has it, and the pattern ends with ``*``.

    ``/base/*_parameters`` spells it out.
    """
    return pattern.rpartition("/")[2] in ("*", "**") and is_of_every_node(kind, name)


def covers(pattern: str, name: str) -> bool:
    """Return whether a full name is the pattern, or matches it with hidden segments included."""
    return pattern == name or ("*" in pattern and _compiled(pattern, hides=False).fullmatch(name) is not None)


def fits_kind(type_name: str, kind: Kind) -> bool:
    """Return whether a type, as ROS 2 writes it, is valid for a topic, a service or an action."""
    return re.fullmatch(TYPE_FORMS[kind][0], type_name) is not None


@functools.lru_cache(maxsize=1024)
def _compiled(pattern: str, *, hides: bool = True) -> re.Pattern[str]:
    return re.compile("".join(_segment(text, _VISIBLE if hides else _ANY) for text in pattern.split("/")[1:]))


def _segment(text: str, whole: str) -> str:
    if text == "**":
        return f"(?:/{whole})+"
    if text == "*":
        return f"/{whole}"
    return "/" + ("(?!_)" if text[0] == "*" and whole == _VISIBLE else "") + text.replace("*", "[A-Za-z0-9_]*")
