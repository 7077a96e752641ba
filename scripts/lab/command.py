"""Commands of the ring and of the demonstrations: entry, exit code, console, and a display of steps.

I/O; prints. Exit codes: 0 passed, 1 failed, 2 wrong input, or what the command itself returns.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Callable, Iterable
from types import FrameType
from typing import Final, NoReturn

import typer
from rich.console import Console, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.text import Text

from gdp.closing import ClosedOnExit
from gdp.errors import GdpError
from gdp.host.interruption import let_nothing_interrupt
from lab.process import FailedError

PASSED: Final = 0
FAILED: Final = 1
_WRONG_INPUT: Final = 2
_WIDE: Final = 160  # columns without a terminal


def new_app() -> typer.Typer:
    """Return an application without what users of a script do not need."""
    return typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


def console_of(*, stderr: bool = False, columns: int = _WIDE) -> Console:
    """Return a console; ``columns``: its width where it is no terminal."""
    console = Console(stderr=stderr)
    return console if console.is_terminal else Console(stderr=stderr, width=columns)


def end_on_signals() -> None:
    """Let Ctrl-C, SIGTERM and SIGHUP end this process by ``SystemExit``; nothing interrupts what is then taken down."""

    def end(number: int, _: FrameType | None) -> NoReturn:
        let_nothing_interrupt()
        sys.exit(128 + number)

    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, end)


def exit_with(work: Callable[[], int]) -> None:
    """Exit with the code that ``work`` returns, or with that of its error, which is printed. Raises ``typer.Exit``."""
    errors = Console(stderr=True, highlight=False, soft_wrap=True)
    try:
        code = work()
    except FailedError as error:
        errors.print(f"[bold red]failed[/bold red]: {escape(str(error))}")
        code = FAILED
    except GdpError as error:
        errors.print(escape(str(error)))
        code = _WRONG_INPUT
    raise typer.Exit(code)


def tell(console: Console, lines: Iterable[str], summary: str, document: object, *, failed: bool, as_json: bool) -> int:
    """Print what a demonstration came to, in lines and a summary, or as JSON in place of that; return the exit code."""
    for line in lines:
        console.print(escape(line), highlight=False, soft_wrap=True)
    if as_json:
        sys.stdout.write(json.dumps(document, indent=1) + "\n")
    else:
        console.print(summary, style="bold red" if failed else "bold green", highlight=False)
    return FAILED if failed else PASSED


class StepDisplay(ClosedOnExit):
    """Display of steps and of the present state; a context manager.

    ``is_kept``: whether the last state stays in the terminal. ``plain_every_s``: time between two plain lines where
    there is no terminal.
    """

    def __init__(self, console: Console, *, is_kept: bool, plain_every_s: float) -> None:
        self._console = console
        self._begun_s = self._reported_s = time.monotonic()
        self._plain_every_s = plain_every_s
        self._live = Live(console=console, auto_refresh=False, transient=not is_kept) if console.is_terminal else None

    def close(self) -> None:
        """End the display."""
        if self._live is not None:
            self._live.stop()

    def step(self, text: str) -> None:
        """Show the present step."""
        line = Text.assemble((f"{time.monotonic() - self._begun_s:5.1f} s  ", "dim"), (text, "bold"))
        self._console.print(line, highlight=False, soft_wrap=True)

    def _show(self, page: RenderableType, line: Text) -> None:
        """Show the present state: the page in a terminal, elsewhere a line every few seconds."""
        if self._live is not None:
            if not self._live.is_started:
                self._live.start()
            self._live.update(page, refresh=True)
        elif time.monotonic() - self._reported_s >= self._plain_every_s:
            self._reported_s = time.monotonic()
            self._console.print(Text("         ") + line, soft_wrap=True)
