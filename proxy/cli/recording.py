"""Command ``gdp recording finish``: completes a recording whose writer was killed.

I/O; ``gdp`` loads it, since the package ``gdp`` does not know ``proxy``.
"""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import Annotated, Final

import typer
from typer.core import TyperGroup

from gdp.cli.node import Json, failing_clearly
from gdp.cli.program import ungrouped
from gdp.errors import LocalError
from proxy.cli.history import export, replay
from proxy.cli.tool_options import print_json, print_text
from proxy.recordings.reader import BagReader
from proxy.recordings.writer import PARTIAL, BagWriter


class _Recording(TyperGroup):
    """Group that lists its own commands; it also has those that ``gdp store`` lists."""

    def list_commands(self, ctx: typer.Context) -> list[str]:  # type: ignore[override]
        """Return the names of the commands, for the help."""
        return [name for name in super().list_commands(ctx) if name not in _OF_STORE]


_OF_STORE: Final = ("export", "replay")
app = typer.Typer(cls=_Recording, add_completion=False, pretty_exceptions_enable=False, no_args_is_help=True)

File = Annotated[Path, typer.Argument(metavar="FILE", help=f"The recording, such as rec.mcap{PARTIAL}.", exists=True)]
Output = Annotated[
    Path | None, typer.Option("--output", "-o", metavar="FILE", help=f"The complete file. Default: without {PARTIAL}.")
]


@app.callback()
def _recording() -> None:
    """Complete a recording whose writer was killed."""


@app.command(
    no_args_is_help=True,
    epilog=f"Examples: gdp recording finish rec.mcap{PARTIAL}; gdp recording finish cut.bag -o whole.bag",
)
def finish(file: File, output: Output = None, json: Json = False) -> None:
    """Write what can be read of a recording as a complete file with an index; FILE goes, if it was ours.

    It reads damaged recordings of others as well: bags, MCAP, sqlite3.
    """
    with failing_clearly():
        whole = output or file.with_name(file.name.removesuffix(PARTIAL))
        if whole == file:
            raise LocalError(f"{file}: say where the complete file goes: --output FILE")
        if whole.exists():
            raise LocalError(f"{whole} exists already")
        with file.open("rb") as opened:
            _refuse_used(file, opened.fileno())
            count, unread = _copy(file, whole)
            if output is None:
                file.unlink()
    if json:
        print_json({"file": str(whole), "messages": count, "unread": unread or None})
    else:
        print_text(f"{count} messages are in {whole}" + (f"; {unread}" if unread else ""))


app.command(epilog="Example: gdp store export /camera/image --node investigator -o incident.mcap")(export)
app.command(epilog="Example: gdp store replay /scan --node investigator --config proxy.yaml --rate 2")(
    ungrouped(replay)
)


def _refuse_used(file: Path, descriptor: int) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        raise LocalError(f"{file} is being written at present") from error


def _copy(file: Path, whole: Path) -> tuple[int, str]:
    """Write a complete file; return its messages, and why others could not be read."""
    made = whole.with_name(f".{whole.name}.finishing")
    copies = made, made.with_name(made.name + PARTIAL)
    for each in copies:
        each.unlink(missing_ok=True)
    try:
        with BagReader(file) as reader:
            ros = reader.channels[0].ros if reader.channels else 2
            with BagWriter(made, ros) as writer:
                handles = [writer.add(channel) for channel in reader.channels]
                for message in reader.messages():
                    writer.write(handles[message.channel], message.stamp_ns, message.raw, message.origin)
            made.rename(whole)
            return writer.written, reader.unread
    finally:  # nothing of a copy that failed stays
        for each in copies:
            each.unlink(missing_ok=True)
