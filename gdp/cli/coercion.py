"""Coercion of a command's words that loads the library of data models only where a word is not the value itself.

Some versions of the command line's library build a model for each option, also for one that is not given, which takes a
third of the time of a short command.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

__all__ = ["defer_coercion"]


class _Coercion:
    """What converts the value of one option; ``make`` returns that of the library, which also raises its errors."""

    def __init__(self, make: Any) -> None:
        self._make = make

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the value of an option."""
        kind = param.type_descriptor.annotation
        if value is None:
            return () if param.multiple or param.nargs == -1 else None
        if type(value) is kind or value == []:  # text, or a default
            return value
        if isinstance(kind, type) and issubclass(kind, Enum) and value in [each.value for each in kind]:
            return kind(value)
        return self._make().coerce(value, param=param, ctx=ctx)


def defer_coercion(command: Any) -> None:
    """Let the options of a command load the library when a value needs it; another version of it is left as it is."""
    find_help = command.get_help_option
    command.get_help_option = lambda ctx: _deferred(find_help(ctx))
    for param in command.params:
        _deferred(param)


def _deferred(param: Any) -> Any:
    kind, make = getattr(param, "type_descriptor", None), getattr(param, "get_runtime_param", None)
    if kind is not None and kind.parameter_info.parser is None and "get_runtime_param" not in vars(param):
        coercion = _Coercion(make)
        param.get_runtime_param = lambda: coercion
    return param
