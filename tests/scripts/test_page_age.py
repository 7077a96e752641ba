"""Age of measured pages, against the history of a small repository."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import page_age
import pytest
import yaml

from tests.pages import ROOT

LISTS = {"experiments": {"fig": ["gdp/client"]}, "benchmarks": {}}


class Repository:
    """Repository with one page, ``docs/experiments/fig.json``."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._git("init", "--quiet")
        self.commit("gdp/client/a.py")

    def commit(self, path: str, text: str = "") -> str:
        """Write a file, and return the commit that holds it."""
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
        self._git("add", path)
        identity = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
        self._git(*identity, "commit", "--quiet", "--allow-empty", "-m", f"change {path}")
        return self._git("rev-parse", "--short=12", "HEAD")

    def page(self, *commits: str) -> None:
        """Commit a page whose parts were measured at these commits."""
        parts = {f"part {at}": {"machine": {"load_before": 0.1, "commit": commit}} for at, commit in enumerate(commits)}
        self.commit("docs/experiments/fig.json", json.dumps(parts))

    def old(self) -> dict[str, str]:
        """Return old pages with their reasons."""
        return dict(page_age.old_pages(self.root, LISTS))

    def _git(self, *words: str) -> str:
        argv = ["git", "-C", str(self.root), *words]
        return subprocess.run(argv, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def repository(tmp_path: Path) -> Repository:
    return Repository(tmp_path)


def test_a_page_is_current_while_what_it_measures_does_not_change(repository: Repository) -> None:
    repository.page(repository.commit("gdp/switch/b.py"))
    repository.commit("gdp/switch/b.py", "changed")
    assert repository.old() == {}


def test_a_page_is_old_after_a_change_of_a_listed_path_or_of_its_script(repository: Repository) -> None:
    for path in ("gdp/client/a.py", "scripts/experiments/fig.py"):
        commit = repository.commit("gdp/switch/b.py", path)
        repository.page(commit)
        repository.commit(path, path)
        assert f"change {path}" in repository.old()["experiments/fig"]


def test_the_oldest_part_of_a_page_counts(repository: Repository) -> None:
    old = repository.commit("gdp/switch/b.py")
    new = repository.commit("gdp/client/a.py", "changed")
    repository.page(old, new)
    assert "change gdp/client/a.py" in repository.old()["experiments/fig"]
    repository.page(new)
    assert repository.old() == {}


@pytest.mark.parametrize(
    ("commit", "reason"),
    [
        ("", "names no commit"),
        ("0123456789ab", "its commit 0123456789ab is not in this repository"),
        ("0123456789ab-dirty", "measured with changes to 0123456789ab that no commit has"),
    ],
)
def test_a_page_whose_code_cannot_be_found_is_old(repository: Repository, commit: str, reason: str) -> None:
    repository.page(commit)
    assert repository.old() == {"experiments/fig": reason}


@pytest.mark.parametrize("is_shallow", [True, False])
def test_without_history_the_check_fails_in_one_line_and_only_warns_in_a_change(
    repository: Repository, tmp_path: Path, is_shallow: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    repository.page("")
    tree, lists = tmp_path / "tree", tmp_path / "pages.yaml"
    lists.write_text(yaml.safe_dump(LISTS), encoding="utf-8")
    tree.mkdir()
    if is_shallow:
        clone = ["git", "clone", "--quiet", "--depth", "1", f"file://{tmp_path}", str(tree)]
        subprocess.run(clone, check=True, capture_output=True)
    with pytest.raises(SystemExit) as ended:
        page_age.main([], tree, lists)
    (line,) = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2
    assert ("run git fetch --unshallow" if is_shallow else "clone it by git") in line
    page_age.main(["--warn"], tree, lists)
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("warning: the age of measured pages is not checked: ")


def test_an_old_page_fails_the_nightly_check_and_warns_in_a_change(
    repository: Repository, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    repository.page("")
    lists = tmp_path / "pages.yaml"
    lists.write_text(yaml.safe_dump(LISTS), encoding="utf-8")
    with pytest.raises(SystemExit, match="experiments/fig: names no commit"):
        page_age.main([], repository.root, lists)
    page_age.main(["--warn"], repository.root, lists)
    assert capsys.readouterr().out.startswith("warning: 1 measured pages are old")


def test_every_shipped_page_has_a_list_of_paths_that_exist() -> None:
    lists = yaml.safe_load(page_age.LISTS.read_text(encoding="utf-8"))
    for kind in ("experiments", "benchmarks"):
        pages = {path.stem for path in (ROOT / "docs" / kind).glob("*.json")}
        assert pages <= lists[kind].keys()
        for paths in lists[kind].values():
            for path in page_age.flat(paths):
                assert list(ROOT.glob(path)), path
