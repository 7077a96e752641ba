"""MkDocs hook: pages may link to files of the repository outside ``docs``.

MkDocs knows the files below ``docs`` only. This hook adds each linked file under ``repository/`` and rewrites the link.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT: Final = Path(__file__).resolve().parents[1]
_DOCS: Final = ROOT / "docs"
_PREFIX: Final = "repository/"
_ENTRY_PAGES: Final = ("CHANGELOG.md", "gdp/frame/spec.md")  # the navigation names these
_LINK: Final = re.compile(r"\]\(([^)\s#]+)(#[^)\s]*)?\)")
_FENCE: Final = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


def _origin(src_uri: str) -> Path:
    """Return the source file of a page of the site."""
    return ROOT / src_uri.removeprefix(_PREFIX) if src_uri.startswith(_PREFIX) else _DOCS / src_uri


def _uri(target: Path) -> str:
    """Return a file's path on the site; a directory stands for its README."""
    target = target / "README.md" if target.is_dir() else target
    return str(target.relative_to(_DOCS)) if target.is_relative_to(_DOCS) else _PREFIX + str(target.relative_to(ROOT))


def _targets(page: Path) -> Iterable[Path]:
    """Yield the files of the repository that a page links to."""
    for path, _ in _LINK.findall(_FENCE.sub("", page.read_text())):
        if ":" not in path:
            target = (page.parent / path).resolve()
            yield target / "README.md" if target.is_dir() else target


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the linked files outside ``docs``, and those that these link to."""
    from mkdocs.structure.files import File

    waiting = [_DOCS / file.src_uri for file in files.documentation_pages()]
    waiting += [ROOT / page for page in _ENTRY_PAGES]
    seen: set[Path] = set()
    while waiting:
        page = waiting.pop()
        if page in seen or not page.is_file():
            continue
        seen.add(page)
        uri = _uri(page)
        if files.get_file_from_path(uri) is None:
            files.append(File.generated(config, uri, abs_src_path=str(page)))
        if page.suffix == ".md":
            waiting += _targets(page)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:  # noqa: ARG001
    """Rewrite the links of a page for its location on the site."""
    source = page.file.src_uri
    origin = _origin(source).parent

    def rewritten(match: re.Match[str]) -> str:
        path, anchor = match[1], match[2] or ""
        if ":" in path:
            return match[0]
        return f"]({os.path.relpath(_uri((origin / path).resolve()), os.path.dirname(source))}{anchor})"

    parts = _FENCE.split(markdown)
    return "".join(part if part.startswith("```") else _LINK.sub(rewritten, part) for part in parts)
