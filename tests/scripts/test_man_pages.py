"""Manual pages: one for each command, and roff that groff and mandoc accept without a warning."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

import man_pages

PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("man")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", "86400")
        assert man_pages.main([str(folder)]) == 0
    return folder


def test_each_command_and_group_has_a_page(folder: Path) -> None:
    names = {path.name for path in folder.iterdir()}
    assert {f"{each}.1" for each in man_pages.PROGRAMS} <= names
    assert {"gdp-topic.1", "gdp-topic-echo.1", "gdp-rib-lookup.1", "gdp-delegate-name.1", "fog-local.1"} <= names
    assert len(names) == len(list(man_pages.pages()))  # no page replaces another one


def test_a_page_has_the_options_and_examples_of_the_help(folder: Path) -> None:
    text = (folder / "gdp-topic-echo.1").read_text()
    assert ".B \\-n, \\-\\-count" in text
    assert "gdp topic echo /odom \\-\\-node keys/viewer \\-\\-once" in text
    assert '"1970-01-02"' in text


@pytest.mark.skipif(shutil.which("groff") is None, reason="groff is not installed")
def test_groff_formats_every_page_without_a_warning(folder: Path) -> None:
    pages = sorted(map(str, folder.iterdir()))
    done = subprocess.run(
        ["groff", "-man", "-Tutf8", "-ww", *pages], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    assert done.stderr == ""


@pytest.mark.skipif(shutil.which("mandoc") is None, reason="mandoc is not installed")
def test_mandoc_finds_nothing_to_warn_of(folder: Path) -> None:
    pages = sorted(map(str, folder.iterdir()))
    done = subprocess.run(
        ["mandoc", "-T", "lint", "-W", "warning", *pages],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.stdout == ""


def test_a_wrong_use_has_exit_code_2() -> None:
    assert man_pages.main([]) == 2
