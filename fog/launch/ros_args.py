"""Command-line arguments for a node's name, remappings and parameters, which need no files on the machine.

Sans-I/O.
Source: https://design.ros2.org/articles/ros_command_line_arguments.html; parameter files in the format of
rcl_yaml_param_parser (sections of nodes that contain ``ros__parameters``).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, TypeAlias

from gdp.errors import LocalError

_PARAMETERS: Final = "ros__parameters"
_INT_MIN, _INT_MAX = -(1 << 63), (1 << 63) - 1
_Section: TypeAlias = tuple[Sequence[str], Mapping[str, object]]


def named(name: str | None, namespace: str | None) -> list[str]:
    """Return the arguments that set a node's name and namespace."""
    words = ["-r", f"__node:={name}"] if name else []
    return [*words, "-r", f"__ns:={_absolute(namespace)}"] if namespace else words


def remapped(pairs: Iterable[tuple[str, str]]) -> list[str]:
    """Return the arguments that remap names."""
    return [word for old, new in pairs for word in ("-r", f"{old}:={new}")]


def parameters_of_map(parameters: Mapping[str, object], prefix: str = "") -> list[str]:
    """Return the arguments that set parameters; a nested map is a group, joined with dots.

    Args:
        prefix: text before each name, such as ``detector:`` to address only the node of that name.
    """
    words = []
    for key, value in _flat(parameters):
        word = f"{prefix}{key}:={_yaml(key, value)}"
        if "\0" in word or not _is_unicode(word):
            raise LocalError(f"parameter {key!r}: a zero byte or half a surrogate pair cannot be in a command line")
        words += ["-p", word]
    return words


def parameters_of_file(document: object, where: str, name: str | None, namespace: str | None) -> list[str]:
    """Return the arguments that set a node's parameters from a parameter file.

    Args:
        name, namespace: of the node; None: not given, so the node's code determines it.
    """
    words = []
    for path, parameters in _sections(document, where, ()):
        node = [part for part in "/".join(path).split("/") if part]
        if node == ["**"]:
            words += parameters_of_map(parameters)
        elif any("*" in part for part in node) or (name is None and len(node) != 1):
            raise LocalError(f"{where}: section {'/'.join(path)}: cannot be used here: name the node, or say /**")
        elif name is None:
            words += parameters_of_map(parameters, f"{node[0]}:")
        elif f"{_absolute(namespace).rstrip('/')}/{name}" == f"/{'/'.join(node)}":
            words += parameters_of_map(parameters)
    return words


def _absolute(namespace: str | None) -> str:
    return "/" + (namespace or "").strip("/")


def _sections(
    document: object, where: str, path: Sequence[str]
) -> Iterator[tuple[Sequence[str], Mapping[str, object]]]:
    if not isinstance(document, Mapping):
        raise LocalError(f"{where}: {'/'.join(path) or 'the file'}: expected nodes with {_PARAMETERS} within")
    for key, value in document.items():
        if key != _PARAMETERS:
            yield from _sections(value, where, (*path, str(key)))
        elif path and isinstance(value, Mapping):
            yield path, value
        else:
            raise LocalError(f"{where}: {'/'.join(path) or 'the file'}: {_PARAMETERS}: expected a map within a node")


def _flat(parameters: Mapping[str, object], group: str = "") -> Iterator[tuple[str, object]]:
    for key, value in parameters.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{group}{key}.")
        else:
            yield f"{group}{key}", value


def _is_unicode(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _yaml(key: str, value: object) -> str:
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return f"[{', '.join(_yaml(key, each) for each in value)}]"
    if isinstance(value, int) and not _INT_MIN <= value <= _INT_MAX:
        raise LocalError(f"parameter {key}: a whole number of a parameter has 64 bits")
    if isinstance(value, float) and not math.isfinite(value):
        return ".nan" if math.isnan(value) else ".inf" if value > 0 else "-.inf"
    if isinstance(value, bool | int | float | str):
        return json.dumps(value, ensure_ascii=False)  # JSON is also YAML
    raise LocalError(f"parameter {key}: {value!r}: expected text, a number, a truth value or a list of such")
