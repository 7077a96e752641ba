"""Clone of this tree, as somebody else would have it: what is committed, and changes that could be committed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.pages import ROOT

__all__ = ["make_clone"]


def make_clone(tree: Path) -> None:
    """Clone this tree into a folder that does not exist; skips the test where it is no clone itself."""
    if not (ROOT / ".git").exists():
        pytest.skip("this tree is no clone of its repository")
    _git("clone", "--quiet", str(ROOT), str(tree))
    changed = _git("-C", str(ROOT), "diff", "--name-only", "-z", "HEAD")
    added = _git("-C", str(ROOT), "ls-files", "--others", "--exclude-standard", "-z")
    for path in filter(None, f"{changed}{added}".split("\0")):
        if (ROOT / path).exists():
            (tree / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / path, tree / path)
        else:
            (tree / path).unlink()


def _git(*words: str) -> str:
    argv = ["git", "-c", "safe.directory=*", *words]
    return subprocess.run(argv, check=True, capture_output=True, text=True).stdout
