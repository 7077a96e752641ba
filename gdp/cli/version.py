"""Options ``--version`` and ``-h`` of every command and sub-command, and the form of its help and of usage errors.

I/O.
Some versions of the command line's library build a model for each option, also for one that is not given, which takes a
third of the time of a short command. So a word is coerced without that library where it is the value itself.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from enum import Enum
from functools import partial
from typing import Annotated, Any, Final

import typer
from typer.main import get_command

import gdp
from gdp.terminal import echo

_SHOULD_BE: Final = "Input should be "  # prefix of pydantic, which some versions of the library use
_USAGE_ERROR: Final[Any] = typer.BadParameter.__mro__[2]  # ClickException, whose module differs among versions
# Context settings, which sub-commands inherit; lines of the help are as wide as the terminal.
HELP: Final = {"help_option_names": ["-h", "--help"], "max_content_width": 1_000}


def _print_and_end(context: typer.Context, is_wanted: bool) -> None:
    if is_wanted:
        from gdp.burst import VARIANT  # it loads the ciphers

        echo(f"{context.find_root().info_name} {gdp.__version__}\nburst core: {VARIANT}")
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", is_eager=True, callback=_print_and_end, help="Print the version and end.")
]


def versioned(app: typer.Typer) -> Callable[..., Any]:
    """Return the command of an application, with the option ``--version`` on every sub-command.

    A usage error is printed as every other error is, and ends the command with exit code 2.
    """
    command = with_version(get_command(app))
    command.main = partial(_run, command.main)  # type: ignore[attr-defined]
    return command


def _run(main: Callable[..., Any], *arguments: Any, **settings: Any) -> None:
    """Run a command and exit with its code."""
    try:
        code = main(*arguments, **settings, standalone_mode=False)
    except _USAGE_ERROR as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            echo(error.format_message())
        else:
            echo(f"error: {error.format_message().replace(_SHOULD_BE, 'expected ')}", err=True)
            if (context := getattr(error, "ctx", None)) is not None:
                echo(f"Try '{context.command_path} -h' for help.", err=True)
        code = error.exit_code
    except typer.Abort:
        echo("error: aborted", err=True)
        code = 1
    sys.exit(code if isinstance(code, int) else 0)


def with_version(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return a command with the option ``--version`` on it and on all below it that are loaded.

    Their help breaks at the width of the terminal alone.
    """
    option = _option()
    for each in _all_of(command):
        each.short_help = each.short_help or (each.help or "").partition("\n\n")[0]  # whole in the help of its group
        each.rich_markup_mode = None  # the help as text: a frame around it takes longer than most commands
        if not any("--version" in param.opts for param in each.params):
            each.params.append(option)
        defer_coercion(each)
    return command


def _option() -> Any:
    """Return the option as the command line's library makes it; its class differs among the library's versions."""
    only = typer.Typer(add_completion=False)

    @only.command()
    def command(version: Version = False) -> None:
        del version

    (option,) = get_command(only).params
    option.expose_value = False
    return option


def _all_of(command: Any) -> Iterator[Any]:
    yield command
    commands = getattr(command, "commands", {})
    for each in getattr(commands, "loaded", commands).values():  # lazy ones get the option when they are loaded
        yield from _all_of(each)


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
