"""Common parts of the commands of long-running nodes: logging, events, errors."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections.abc import Iterator
from datetime import datetime, timezone
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple, TypeVar, get_args

import orjson
import typer

from gdp.errors import ConfigError, GdpError, LocalError
from gdp.terminal import echo, unblocked

if TYPE_CHECKING:
    from pydantic import BaseModel

# NumPy's OpenBLAS starts a thread for each core as soon as it is loaded. No command uses them, and a thread that exists
# before the confinement of rights keeps its rights.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_OURS: Final = ("gdp", "proxy", "fog", "gdp_extensions")
WRONG: Final = 2  # exit code of a wrong configuration

Config = Annotated[
    Path, typer.Option("--config", metavar="FILE", help="The YAML file; see docs/reference/configuration.md.")
]
FoundConfig = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", help="The YAML file; by default the one that this machine has."),
]
Check = Annotated[bool, typer.Option("--check", help="Validate the configuration and end.")]
AwaitIface = Annotated[
    float,
    typer.Option(min=0.0, metavar="SECONDS", help="Wait so long for the device, which a switch may just be making."),
]
Json = Annotated[bool, typer.Option("--json", help="Say what happens as lines of JSON on standard output.")]
MemberPlane = Annotated[
    str | None, typer.Option("--data-plane", metavar="PLANE", help="raw or scapy; instead of the file's.")
]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Log decisions, too; as --log-level debug.")]


class Level(str, Enum):
    """Least serious level that is logged."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class Format(str, Enum):
    """Form of a log line."""

    TEXT = "text"
    JSON = "json"


class Logs(NamedTuple):
    """Options of what a node logs."""

    verbose: Verbose = False
    log_level: Annotated[
        Level,
        typer.Option("--log-level", help="debug: decisions; info: steps; warning: what is degraded; error: failures."),
    ] = Level.INFO
    log_format: Annotated[
        Format, typer.Option("--log-format", help="Lines on standard error: text, or objects of JSON.")
    ] = Format.TEXT


_Settings = TypeVar("_Settings", bound="BaseModel")


@contextlib.contextmanager
def running(logs: Logs) -> Iterator[None]:
    """Log as the options say; print an error of ours as one line on standard error, and exit with code 2.

    A node never blocks on its output: lines that are not read are dropped and counted.
    """
    set_up_logging(verbose=logs.verbose, level=logs.log_level, form=logs.log_format)
    with contextlib.redirect_stdout(unblocked(sys.stdout)), failing_clearly():
        yield


def set_up_logging(
    *, verbose: bool, quiet: bool = False, level: Level = Level.INFO, form: Format = Format.TEXT
) -> None:
    """Log to standard error: life-cycle steps, or decisions as well.

    Args:
        verbose: log decisions, whatever the level.
        quiet: log warnings alone unless ``verbose``.
    """
    least = logging.DEBUG if verbose else logging.WARNING if quiet else getattr(logging, level.name)
    module = " %(name)s" if least <= logging.DEBUG else ""
    form_of_line = f"%(asctime)s %(levelname)s{module} %(message)s"
    logging.basicConfig(level=least, stream=unblocked(sys.stderr), format=form_of_line)
    for handler in logging.getLogger().handlers:
        handler.addFilter(_is_ours_or_serious)
        if form is Format.JSON:
            handler.setFormatter(_JsonLines())


def _is_ours_or_serious(record: logging.LogRecord) -> bool:
    """Exclude debug messages of libraries: pyroute2 sets its own level and would print every netlink message."""
    return record.levelno >= logging.WARNING or record.name.partition(".")[0] in _OURS


def with_plane(settings: _Settings, data_plane: str | None) -> _Settings:
    """Return the configuration with the data plane of the command line, None: with its own.

    Raises:
        LocalError: there is no such data plane.
    """
    if data_plane is None:
        return settings
    known = get_args(type(settings).model_fields["data_plane"].annotation)
    if data_plane not in known:
        separator = " or " if len(known) == 2 else ", "
        raise LocalError(f"--data-plane is {separator.join(known)}, not {data_plane}")
    return settings.model_copy(update={"data_plane": data_plane})


def emit(event: str, **fields: object) -> None:
    """Write one line of JSON and flush it, because a reader waits for it."""
    echo(orjson.dumps({"event": event, **fields}).decode())


def report(event: str, text: str, *, json: bool, **fields: object) -> None:
    """Write an event as one line of JSON, or its text for people."""
    if json:
        emit(event, **fields)
    else:
        echo(text)


def emit_wait(reason: str, text: str) -> None:
    """Write what a node waits for as one line of JSON."""
    emit("waiting", reason=reason, text=text)


@contextlib.contextmanager
def failing_clearly() -> Iterator[None]:
    """Print an error of ours as one line on standard error, and exit with code 2."""
    try:
        yield
    except ConfigError as error:
        echo(str(error), err=True)
        raise typer.Exit(WRONG) from error
    except GdpError as error:
        echo(f"error: {error}", err=True)
        raise typer.Exit(WRONG) from error


class _JsonLines(logging.Formatter):
    """One object a record: ``time`` (RFC 3339, UTC), ``level``, ``logger``, ``message``; ``trace`` of an exception."""

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as one line without its end."""
        fields = {
            "time": datetime.fromtimestamp(record.created, timezone.utc).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info is not None:
            fields["trace"] = self.formatException(record.exc_info)
        return orjson.dumps(fields).decode()
