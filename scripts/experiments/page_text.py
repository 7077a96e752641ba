"""Text of the pages, with figures in place of ``{name}``, and figures of the papers. I/O: reads files of ``pages``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

import yaml

_PAGES = Path(__file__).with_name("pages")
PAPERS: Final[dict[str, Any]] = yaml.safe_load((_PAGES / "papers.yaml").read_text(encoding="utf-8"))
_WRAPPED = re.compile(r"(?<!```bash)(?<=[^\n])\n(?!\n|\Z|- |#|```)\s*")


def text_of(name: str, **figures: object) -> str:
    """Return a text with its figures, in which each paragraph and each item of a list is one line."""
    text = (_PAGES / f"{name}.md").read_text(encoding="utf-8").rstrip("\n")
    return _WRAPPED.sub(" ", text).format(**figures)
