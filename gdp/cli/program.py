"""Program with a command line: the frame that all programs share, and options that come in groups.

I/O. A parameter of a command whose type is a ``NamedTuple`` stands for the options that are its fields, in its place.
"""

from __future__ import annotations

import functools
import inspect
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, get_type_hints

import typer

from gdp.cli.version import HELP, versioned
from gdp.errors import GdpError
from gdp.terminal import echo


class Program(typer.Typer):
    """Application whose commands may take groups of options.

    Args:
        name: of the program, such as ``gdp-switch``.
        settings: of the application.
    """

    def __init__(self, name: str, **settings: Any) -> None:
        super().__init__(
            name=name, add_completion=False, pretty_exceptions_enable=False, context_settings=HELP, **settings
        )
        self._name = name

    def command(self, name: str | None = None, **settings: Any) -> Callable[[Any], Any]:
        """Return a decorator that adds a function as a command, and returns the function."""
        add = super().command(name, **{"context_settings": HELP, **settings})

        def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
            add(ungrouped(function))
            return function

        return decorate

    def run(self, arguments: Sequence[str] | None = None, *, name: str = "") -> None:
        """Run the program and exit with its code; an error of ours is one line on standard error, and code 2.

        Args:
            arguments: as after the program's name; by default those of this process.
            name: of the program, if another one starts it.
        """
        _allow_completion(name or self._name)
        try:
            versioned(self)(args=None if arguments is None else list(arguments), prog_name=name or self._name)
        except GdpError as error:
            echo(f"error: {error}", err=True)
            sys.exit(2)


def _allow_completion(program: str) -> None:
    """Prepare the answer to a shell that completes this program's words; otherwise do nothing."""
    if os.environ.get(f"_{program.upper().replace('-', '_')}_COMPLETE"):
        from typer.completion import get_completion_inspect_parameters

        get_completion_inspect_parameters()  # registers the shells


def ungrouped(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function of the single options for typer, of a function that takes groups of options."""
    parameters = inspect.signature(function, eval_str=True).parameters.values()
    groups = {each.name: each.annotation for each in parameters if hasattr(each.annotation, "_fields")}
    if not groups:
        return function

    @functools.wraps(function)
    def call(**options: Any) -> Any:
        for name, group in groups.items():
            options[name] = group(**{field: options.pop(field) for field in group._fields})
        return function(**options)

    single = [option for each in parameters for option in _options(each)]
    call.__signature__ = inspect.Signature(single)  # type: ignore[attr-defined]
    return call


def _options(parameter: inspect.Parameter) -> Iterator[inspect.Parameter]:
    """Yield a parameter, or one for each option of a group."""
    group, kind = parameter.annotation, inspect.Parameter.KEYWORD_ONLY
    if not hasattr(group, "_fields"):
        yield parameter.replace(kind=kind)
        return
    for name, hint in get_type_hints(group, include_extras=True).items():
        default = group._field_defaults.get(name, inspect.Parameter.empty)
        yield inspect.Parameter(name, kind, default=default, annotation=hint)
