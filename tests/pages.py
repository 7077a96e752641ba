"""Documentation pages, as tests read them: code blocks, tables, links, and the commands that they show."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
_ALONE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md", "docs/model/README.md", "gdp/frame/spec.md")
KINDS = ("tutorials", "how-to", "reference", "explanation", "contributing")
PAGES = (
    *(ROOT / path for path in _ALONE),
    *sorted((ROOT / "docs").glob("*.md")),
    *(page for kind in KINDS for page in sorted((ROOT / "docs" / kind).glob("*.md"))),
    *(page for shown in ("benchmarks", "experiments", "adr") for page in sorted((ROOT / "docs" / shown).glob("*.md"))),
)

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
_WRAPPED = re.compile(r"\\\n\s*")
_CLAIMED = re.compile(r"`([^`]+)`(?: \((\d+) (s|min)\))?")
_PROGRAM = re.compile(r"(?:gdp(?:-\w+)?|fog|scripts/\w+\.(?:sh|py)|scripts/(?:bench|supply)/\w+\.py)\Z")


@dataclass(frozen=True)
class Block:
    """Code block; ``title`` is its first line if that is a comment, such as ``on the robot``."""

    page: Path
    language: str
    text: str

    @property
    def title(self) -> str:
        first = self.text.partition("\n")[0]
        return first[2:] if first.startswith("# ") else ""

    @property
    def lines(self) -> list[str]:
        """Command lines, each whole, without comments between them; a loop is one."""
        found: list[str] = []
        depth = 0
        for line in _WRAPPED.sub("", self.text).splitlines():
            if not line.strip() or line.startswith("#"):
                continue
            if depth:
                found[-1] += "\n" + line
            else:
                found.append(line)
            depth += line.startswith("for ") - (line == "done")
        return found


@dataclass(frozen=True)
class Claim:
    """Row of ``docs/papers.md``; ``commands``: each with its seconds, None for a test of the project."""

    title: str
    commands: tuple[tuple[str, int | None], ...]
    cells: tuple[str, ...]

    @property
    def shown(self) -> list[str]:
        """Return what its commands are to print: the code in the third cell."""
        return [text for text, _, _ in _CLAIMED.findall(self.cells[2])]


def claims() -> list[Claim]:
    """Return the rows of ``docs/papers.md``, in order."""
    found = []
    for line in (ROOT / "docs/papers.md").read_text().splitlines():
        cells = tuple(cell.strip() for cell in line.split("|")[1:-1])
        if cells and cells[1] != "command" and not cells[1].startswith("---"):
            said = _CLAIMED.findall(cells[1])
            times = (int(number) * {"s": 1, "min": 60}[unit] if number else None for _, number, unit in said)
            found.append(Claim(cells[0], tuple(zip((text for text, _, _ in said), times, strict=True)), cells))
    return found


def blocks(page: Path) -> list[Block]:
    """Return the code blocks of a page, in order."""
    return [Block(page, language, text) for language, text in _FENCE.findall(page.read_text())]


def blocks_between(page: Path, heading: str) -> list[Block]:
    """Return the code blocks under one heading of the second level."""
    parts = re.split(r"^## ", page.read_text(), flags=re.MULTILINE)
    (part,) = (part for part in parts if part.startswith(heading + "\n"))
    return [Block(page, language, text) for language, text in _FENCE.findall(part)]


def links(page: Path) -> list[str]:
    """Return the targets of a page's links."""
    return _LINK.findall(_FENCE.sub("", page.read_text()))


def anchors(page: Path) -> set[str]:
    """Return the possible texts after ``#`` in a link to a page, as GitHub derives them from headings."""
    headings = _HEADING.findall(_FENCE.sub("", page.read_text()))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def rows(text: str) -> Iterator[tuple[str, str]]:
    """Yield the first two cells of each table row whose first is code, without the marks."""
    for key, value in re.findall(r"^\| `([^`|]+)` \| ([^|]+?) \|", text, re.MULTILINE):
        yield key, value.strip("`")


def commands(lines: Sequence[str]) -> Iterator[list[str]]:
    """Yield the words of each command of ours; placeholders of a shell are skipped."""
    for line in lines:
        words = shlex.split(line.removesuffix("&"), comments=True)
        words = words[words[:1] == ["sudo"] :]
        if words and _PROGRAM.match(words[0]) and "$" not in line and not line.startswith("for "):
            yield words
