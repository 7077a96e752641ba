"""Commands whose modules are imported when they are used: a program that has forty starts as fast as one that has one.

I/O: imports modules. Source: click's documentation, "Lazily loading subcommands".
"""

from __future__ import annotations

import importlib
from collections import UserDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import typer
from typer.main import get_command, get_group

from gdp.cli.program import ungrouped
from gdp.cli.version import with_version


@dataclass(frozen=True, slots=True)
class LazyCommand:
    """Where a command is.

    Attributes:
        target: ``module:attribute``; the attribute is a function, or an application with commands of its own.
        summary: for the help of the group, which loads no command.
        no_args_is_help: whether a function without arguments prints its help.
        settings: of the context of a function.
        is_placeholder: a function that stands for more than one command; its help is the summary.
    """

    target: str
    summary: str
    no_args_is_help: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)
    is_placeholder: bool = False

    def import_as(self, name: str) -> Any:
        """Return the command, named ``name``, with the option ``--version`` on it and on all below it."""
        module, _, attribute = self.target.partition(":")
        found = getattr(importlib.import_module(module), attribute)
        command: Any
        if isinstance(found, typer.Typer):
            command = get_group(found)
        else:
            only = typer.Typer(add_completion=False)
            settings = dict(self.settings)
            only.command(
                name,
                help=self.summary if self.is_placeholder else None,
                no_args_is_help=self.no_args_is_help,
                context_settings=settings,
            )(ungrouped(found))
            command = get_command(only)
        command.name = name
        return with_version(command)


class LazyCommands(UserDict[str, Any]):
    """Commands of a group by name, in the order of its help; each is loaded when it is first read.

    Args:
        known: where each is.
    """

    def __init__(self, known: Mapping[str, LazyCommand]) -> None:
        super().__init__(known)
        self._known = known

    @property
    def loaded(self) -> dict[str, Any]:
        """Return those that were read."""
        return {name: each for name, each in self.data.items() if not isinstance(each, LazyCommand)}

    def summaries(self) -> list[tuple[str, str]]:
        """Return each name with what its command is for, without a load."""
        return [(name, each.summary) for name, each in self._known.items()]

    def __getitem__(self, name: str) -> Any:
        """Return a command. Raises ``KeyError``: there is none of that name."""
        found = self.data[name]
        if isinstance(found, LazyCommand):
            found = self.data[name] = found.import_as(name)
        return found
