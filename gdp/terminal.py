"""Output of commands: text of others, escaped where it goes to a terminal, which obeys control characters.

I/O. Files and pipes get the text as it is.
"""

from __future__ import annotations

import sys

from gdp.printable import escaped


def echo(text: str = "", *, err: bool = False) -> None:
    """Print text and a line feed, and flush it; ``err``: to standard error."""
    stream = sys.stderr if err else sys.stdout
    shown = escaped(text) if stream.isatty() else text
    stream.write(shown.encode("utf-8", "backslashreplace").decode() + "\n")
    stream.flush()


def for_stdout(text: str) -> str:
    """Return text as standard output may have it."""
    return escaped(text) if sys.stdout.isatty() else text
