"""Private files in a git work tree: key folders are ignored by git, and a work tree is no key folder."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from gdp.errors import LocalError
from gdp.stores.files import ignore_folder, work_tree_of
from gdp.stores.issue import make_owner


def _gdp(*words: str) -> None:
    with pytest.raises(SystemExit) as leaving:
        main(words)
    assert not leaving.value.code


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_no_private_file_of_a_lab_would_be_added_to_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    subprocess.run(["git", "init", "-q"], check=True)
    _gdp("lab", "robot", "server")
    _gdp("keygen", "node", "keys/arm", "--role", "proxy", "--label", "arm")
    listing = ["git", "ls-files", "--others", "--exclude-standard"]
    shown = subprocess.run(listing, capture_output=True, text=True, check=True).stdout.split()
    private = [each.relative_to(tmp_path) for each in tmp_path.rglob("*") if each.suffix in (".key", ".delegation")]
    assert len(private) > 10
    assert not {str(each) for each in private} & set(shown)
    assert "robot/switch.yaml" in shown  # configuration may be committed


def test_keys_are_not_made_in_the_root_of_a_work_tree(tmp_path: Path) -> None:
    (tmp_path / ".git").mkdir()
    with pytest.raises(LocalError, match="keep keys in a folder of their own"):
        make_owner(tmp_path)
    assert [each.name for each in tmp_path.iterdir()] == [".git"]


def test_a_gitignore_that_is_there_stays(tmp_path: Path) -> None:
    (tmp_path / ".gitignore").write_text("*.tmp\n")
    ignore_folder(tmp_path)
    assert (tmp_path / ".gitignore").read_text() == "*.tmp\n"


def test_the_work_tree_of_a_path_is_the_nearest_folder_with_a_repository(tmp_path: Path) -> None:
    (tmp_path / "code/.git").mkdir(parents=True)
    assert work_tree_of(tmp_path / "code/keys/one") == tmp_path / "code"
    assert work_tree_of(tmp_path / "elsewhere") is None
