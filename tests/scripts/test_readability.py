"""Readability figures: what counts as a listed word, a sentence, a missing docstring; and that limits only tighten."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path

import pytest

import readability

SETTINGS = readability.Settings.from_file(readability.SETTINGS)
LISTED = min(SETTINGS.words)  # any of them, so that this file holds none


def found(text: str, path: str = "docs/page.md") -> list[str]:
    return [str(place) for place in readability.words_in(text, path, SETTINGS)]


@pytest.mark.parametrize("text", ["{}", "is_{}_s", "{}By", "Un{}", "make{}"])
def test_a_listed_word_is_found_as_a_part_of_an_identifier(text: str) -> None:
    assert len(found(text.format(LISTED.capitalize()))) == 1


def test_a_listed_word_inside_a_longer_word_is_not_found() -> None:
    assert not found(f"x{LISTED}x {LISTED}ab")


def test_a_finding_names_file_line_and_column() -> None:
    assert found(f"first\nthe {LISTED}") == [f"docs/page.md:2:5: {LISTED}"]


def test_names_of_the_standard_library_are_allowed() -> None:
    assert not found("os.walk(top), math.floor(x), ast.walk(tree)")


def test_the_changelog_may_quote_old_names() -> None:
    assert not found(f"`{LISTED}_s` is now `x_s`", "CHANGELOG.md")
    assert found(f"{LISTED} stays a listed word", "CHANGELOG.md")


def test_sentences_leave_out_headings_tables_and_code() -> None:
    page = (
        "# A head\n\nOne two. Three `a b c` four.\nFive.\n\n| a | b |\n\n```bash\nrun it. Now\n```\n- Six seven\n"
        + "- Eight\n"
    )
    assert [readability.word_count(each) for each in readability.sentences(page)] == [2, 3, 1, 2, 1]


def test_public_definitions_need_a_docstring_and_private_ones_do_not() -> None:
    tree = ast.parse(
        "def f(): ...\ndef _g(): ...\nclass A:\n    '''Doc.'''\n    def m(self): ...\n    def _n(self): ..."
    )
    assert [place.text for place in readability.undocumented({"a.py": tree})] == ["f", "A.m"]


def test_a_method_name_counts_once_for_each_package() -> None:
    tree = ast.parse("class A:\n    def ask(self): ...\nclass B:\n    def ask(self): ...\n    def close(self): ...")
    trees = {"gdp/a/x.py": tree, "gdp/a/y.py": tree, "fog/b/x.py": tree}
    assert readability.shared_names(trees, frozenset({"close"})) == [(2, "ask")]


def test_a_figure_beyond_its_limit_is_a_regression() -> None:
    assert readability.regressions({"listed words": 3.0}, {"listed words": 3.0}) == []
    assert readability.regressions({"listed words": 4.0}, {"listed words": 3.0}) == ["listed words: 4, limit 3"]


def test_fewer_tests_are_a_regression() -> None:
    assert readability.regressions({"tests": 9.0}, {"tests": 10.0})
    assert not readability.regressions({"tests": 11.0}, {"tests": 10.0})


def test_saving_limits_keeps_the_rest_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "limits.json"
    path.write_text(json.dumps({"words": {"a": ["a"]}, "limits": {"tests": 1}}))
    readability.save_limits(path, {"tests": 2.0})
    assert json.loads(path.read_text()) == {"words": {"a": ["a"]}, "limits": {"tests": 2.0}}


def test_each_exception_has_a_reason() -> None:
    for each in json.loads(readability.SETTINGS.read_text())["allowed"]:
        assert re.search(r"\w", each["reason"])
