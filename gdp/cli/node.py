"""Common parts of the commands of long-running nodes: logging, events, errors.

I/O.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final

import orjson
import typer

from gdp.errors import ConfigError, GdpError

__all__ = [
    "WRONG",
    "AwaitIface",
    "Check",
    "Config",
    "Json",
    "Verbose",
    "emit",
    "emit_wait",
    "failing_clearly",
    "set_up_logging",
]

# NumPy's OpenBLAS starts a thread for each core as soon as it is loaded. No command uses them, and a thread that exists
# before the confinement of rights keeps its rights.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_OURS: Final = ("gdp", "proxy", "fog")
WRONG: Final = 2  # exit code of a wrong configuration

Config = Annotated[Path, typer.Option("--config", help="The YAML file; see docs/reference/configuration.md.")]
Check = Annotated[bool, typer.Option("--check", help="Validate the configuration and end.")]
AwaitIface = Annotated[
    float,
    typer.Option(min=0.0, metavar="SECONDS", help="Wait so long for the device, which a switch may just be making."),
]
Json = Annotated[bool, typer.Option("--json", help="Say what happens as lines of JSON on standard output.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Log decisions, too.")]


def set_up_logging(*, verbose: bool) -> None:
    """Log to standard error: life-cycle steps, or decisions as well."""
    level = logging.DEBUG if verbose else logging.INFO
    logging.basicConfig(level=level, stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s %(message)s")
    for handler in logging.getLogger().handlers:
        handler.addFilter(_is_ours_or_serious)


def _is_ours_or_serious(record: logging.LogRecord) -> bool:
    """Exclude debug messages of libraries: pyroute2 sets its own level and would print every netlink message."""
    return record.levelno >= logging.WARNING or record.name.partition(".")[0] in _OURS


def emit(event: str, **fields: object) -> None:
    """Write one line of JSON and flush it, because a reader waits for it."""
    sys.stdout.buffer.write(orjson.dumps({"event": event, **fields}) + b"\n")
    sys.stdout.buffer.flush()


def emit_wait(reason: str, text: str) -> None:
    """Write what a node waits for as one line of JSON."""
    emit("waiting", reason=reason, text=text)


@contextlib.contextmanager
def failing_clearly() -> Iterator[None]:
    """Print an error of ours as one line on standard error, and exit with code 2."""
    try:
        yield
    except ConfigError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(WRONG) from error
    except GdpError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(WRONG) from error
