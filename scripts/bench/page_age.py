#!/usr/bin/env python3
"""Check of the age of measured pages: none is older than the last change of what it measures.

    .venv/bin/python scripts/bench/page_age.py             # exit 1: a page is old; exit 2: no history to compare with
    .venv/bin/python scripts/bench/page_age.py --warn      # the same as one line, and exit 0: for a change

I/O: reads the JSON below ``docs`` and git. ``pages.yaml`` lists what each page measures.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import yaml
from machine import ROOT, RefusedError, git

LISTS: Final = Path(__file__).with_name("pages.yaml")
_SCRIPTS: Final = {"experiments": "scripts/experiments", "benchmarks": "scripts/bench"}


def main(words: Sequence[str] | None = None, root: Path = ROOT, lists: Path = LISTS) -> None:
    """Report old pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--warn", action="store_true", help="print one line, and exit 0")
    options = parser.parse_args(words)
    try:
        old = dict(old_pages(root, yaml.safe_load(lists.read_text(encoding="utf-8"))))
    except RefusedError as error:
        if options.warn:
            print(f"warning: the age of measured pages is not checked: {error}")
            return
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    if options.warn and old:
        print(f"warning: {len(old)} measured pages are old: scripts/bench/page_age.py lists them")
    elif old:
        sys.exit("\n".join(f"{page}: {reason}" for page, reason in old.items()))


def old_pages(root: Path, lists: dict[str, dict[str, list[Any]]]) -> Iterator[tuple[str, str]]:
    """Yield each old page with the reason. Raises ``RefusedError``: there is no history."""
    try:
        if git("rev-parse", "--is-shallow-repository", root=root) == "true":
            raise RefusedError(f"{root} is a shallow clone: run git fetch --unshallow")
    except (OSError, subprocess.CalledProcessError) as error:
        raise RefusedError(f"{root} is no git repository: clone it by git") from error
    for kind, scripts in _SCRIPTS.items():
        for path in sorted((root / "docs" / kind).glob("*.json")):
            listed = lists[kind].get(path.stem)
            paths = [f"{scripts}/{path.stem}.py", *flat(listed or [])]
            reasons = (_reason(commit, paths, root) for commit in sorted(_commits(json.loads(path.read_text()))))
            if reason := next(filter(None, reasons), "" if listed else f"no list of paths in {LISTS.name}"):
                yield f"{kind}/{path.stem}", reason


def _reason(commit: str, paths: Sequence[str], root: Path) -> str:
    """Return why figures of a commit are old; empty: they are not."""
    if not commit:
        return "names no commit"
    if commit.endswith("-dirty"):
        return f"measured with changes to {commit.removesuffix('-dirty')} that no commit has"
    try:
        changed = git("log", "-1", "--format=%h %s", f"{commit}..HEAD", "--", *paths, root=root)
    except subprocess.CalledProcessError:
        return f"its commit {commit} is not in this repository"
    return f"older than {changed}" if changed else ""


def _commits(document: Any) -> set[str]:
    """Return the commit of each part of a document that names its machine or its load; empty text: it has none."""
    return set(_stamps(document)) or {""}


def _stamps(item: Any) -> Iterator[str]:
    if isinstance(item, dict):
        if "load_before" in item:
            yield item.get("commit", "")
        for each in item.values():
            yield from _stamps(each)


def flat(paths: Sequence[Any]) -> Iterator[str]:
    """Yield the paths of a list that also holds lists."""
    for each in paths:
        yield from [each] if isinstance(each, str) else each


if __name__ == "__main__":
    main()
