"""Parser of parameter YAML: one document of bounded size, without aliases.

Sans-I/O.
Source: rcl_yaml_param_parser, which refuses aliases too ("Will not support aliasing"). With aliases, a few hundred
bytes can expand to gigabytes. Events are checked before any object is built.
"""

from __future__ import annotations

from typing import Final

import yaml

from gdp.config.yaml_source import LOADER
from gdp.errors import LocalError

BYTES_MAX: Final = 1 << 20
DEPTH_MAX: Final = 32
_TUPLE: Final = "tag:yaml.org,2002:python/tuple"


def read_parameters(text: str, where: str, *, has_tuples: bool = False) -> object:
    """Return the value of a YAML text.

    Args:
        where: file or subject of the text, for errors.
        has_tuples: ``!!python/tuple`` is read as a list; other Python tags are refused.
    """
    size = len(text.encode(errors="replace"))
    if size > BYTES_MAX:
        raise LocalError(f"{where}: {size} bytes; parameters have at most {BYTES_MAX}")
    try:
        _refuse_aliases(text, where)
        document: object = yaml.load(text, _WithTuples if has_tuples else LOADER)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = None if mark is None else mark.line
        raise LocalError(f"{_at(where, line)}: YAML is expected: {error.problem or error.context}") from error
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # ValueError: a date such as 2001-99-99
        raise LocalError(f"{where}: YAML is expected: {error}") from error
    return document


def _refuse_aliases(text: str, where: str) -> None:
    depth = 0
    for event in yaml.parse(text, Loader=LOADER):
        line = event.start_mark.line if event.start_mark else None
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent):
            raise LocalError(f"{_at(where, line)}: aliases are not accepted; write the value out")
        if depth > DEPTH_MAX:
            raise LocalError(f"{_at(where, line)}: nested deeper than {DEPTH_MAX}")


def _at(where: str, line: int | None) -> str:
    return where if line is None else f"{where}:{line + 1}"


def _list(loader: yaml.SafeLoader, node: yaml.SequenceNode) -> list[object]:
    return list(loader.construct_sequence(node))


class _WithTuples(LOADER):  # type: ignore[misc]
    """Loader that reads ``!!python/tuple`` as a list."""


_WithTuples.add_constructor(_TUPLE, _list)
