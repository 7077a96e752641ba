"""Group whose further commands come from the package ``proxy``, which ``gdp`` loads by name only.

I/O. Where ``proxy`` is not installed, the group's own placeholders say how to install it.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, ClassVar, cast

import typer
import typer.main
from typer.core import TyperGroup

from gdp.cli.version import versioned
from gdp.errors import LocalError
from gdp.extras import MissingExtraError

if TYPE_CHECKING:
    from typer import Context

__all__ = ["ANY_ARGUMENTS", "ExtendedGroup", "placeholder"]

ANY_ARGUMENTS = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": list[str]()}


def placeholder(context: typer.Context) -> None:
    """Run a command of the package proxy, which is not installed, or only without its extras."""
    raise LocalError(f"{context.command_path} needs the package proxy (run: pip install 'gdp-ros[proxy,doors]')")


class ExtendedGroup(TyperGroup):
    """Group with commands of other modules.

    Attributes:
        extensions: command to the module whose ``app`` is it, or has it.
    """

    extensions: ClassVar[Mapping[str, str]] = {}

    def get_command(self, ctx: Context, cmd_name: str) -> typer.core.TyperCommand | None:  # type: ignore[override]
        """Return a command, those of other modules as they are there."""
        module = self.extensions.get(cmd_name)
        if module is None or find_spec("proxy") is None:
            return super().get_command(ctx, cmd_name)  # type: ignore[return-value]
        try:
            loaded: Any = versioned(importlib.import_module(module).app)
        except (ModuleNotFoundError, MissingExtraError):
            # an extra is not installed: the placeholder says so when it runs
            return super().get_command(ctx, cmd_name)  # type: ignore[return-value]
        found = loaded.commands.get(cmd_name, loaded) if isinstance(loaded, TyperGroup) else loaded
        found.name = cmd_name
        return cast("typer.core.TyperCommand", found)
