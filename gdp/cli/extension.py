"""Group whose further commands come from other packages and extensions: entry points of the group ``gdp.command``.

I/O. Where one is not installed, the group's own placeholders say how to install it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Final, cast

import typer
import typer.main
from typer.core import TyperGroup

from gdp.cli.version import versioned
from gdp.extras import MissingExtraError, Seam, find_entry_point

if TYPE_CHECKING:
    from typer import Context

ANY_ARGUMENTS = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": list[str]()}
_EXTRAS: Final = {
    **dict.fromkeys(("delegate", "recording", "rule", "service", "topic", "watch"), "proxy"),
    **dict.fromkeys(("foxglove", "rosbridge"), "proxy,doors"),
    **dict.fromkeys(("decrypt-pcap", "wireshark"), "scapy"),
    "suggest": "proxy,dds",
}
COMMANDS: Final[Seam[Any]] = Seam("gdp.command", _EXTRAS)


def placeholder(context: typer.Context) -> None:
    """Run a command that comes from elsewhere, where it or a package that it needs is not installed."""
    group: Any = context.parent and context.parent.command
    COMMANDS.get(group.extensions[context.info_name], context.command_path)


class ExtendedGroup(TyperGroup):
    """Group with commands of other packages.

    Attributes:
        extensions: command to the entry point of the application that is it, or has it.
    """

    extensions: ClassVar[Mapping[str, str]] = {}

    def get_command(self, ctx: Context, cmd_name: str) -> typer.core.TyperCommand | None:  # type: ignore[override]
        """Return a command, those of other packages as they are there."""
        name = self.extensions.get(cmd_name)
        point = None if name is None else find_entry_point("gdp.command", name)
        if point is None:
            return super().get_command(ctx, cmd_name)  # type: ignore[return-value]
        try:
            loaded: Any = versioned(point.load())
        except (ModuleNotFoundError, MissingExtraError):
            # an extra is not installed: the placeholder says so when it runs
            return super().get_command(ctx, cmd_name)  # type: ignore[return-value]
        found = loaded.commands.get(cmd_name, loaded) if isinstance(loaded, TyperGroup) else loaded
        found.name = cmd_name
        return cast("typer.core.TyperCommand", found)
