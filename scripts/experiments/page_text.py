"""Text of the pages: the Markdown files of ``pages``, with figures in place of ``{name}``. I/O: reads one file."""

from __future__ import annotations

import re
from pathlib import Path

_PAGES = Path(__file__).with_name("pages")
_WRAPPED = re.compile(r"(?<!```bash)(?<=[^\n])\n(?!\n|\Z|- |#|```)\s*")


def text_of(name: str, **figures: object) -> str:
    """Return a text with its figures, in which each paragraph and each item of a list is one line."""
    text = (_PAGES / f"{name}.md").read_text(encoding="utf-8").rstrip("\n")
    return _WRAPPED.sub(" ", text).format(**figures)
