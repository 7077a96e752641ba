"""Readability figures: what counts as a listed word, and as a sentence; and that limits only tighten."""

from __future__ import annotations

import ast
import json
import re
import subprocess
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


def test_saved_limits_only_get_tighter_and_the_rest_of_the_file_stays(tmp_path: Path) -> None:
    path = tmp_path / "limits.json"
    path.write_text(json.dumps({"words": {"a": ["a"]}, "limits": {"tests": 5, "product lines": 90, "gone": 1}}))
    readability.save_limits(path, {"tests": 4.0, "product lines": 80, "words of docs": 7})
    limits = {"tests": 5, "product lines": 80, "words of docs": 7}
    assert json.loads(path.read_text()) == {"words": {"a": ["a"]}, "limits": limits}


def test_a_limit_that_was_raised_needs_a_reason() -> None:
    versions: list[dict[str, float]] = [{"product lines": 90}, {"product lines": 80}, {"product lines": 85, "new": 1}]
    reason = {"figure": "product lines", "limit": 85, "reason": "a door"}
    assert readability.loosened(versions, []) == [
        "product lines: the limit was raised from 80 to 85 without a reason in raised_limits.yaml"
    ]
    assert readability.loosened(versions, [reason | {"limit": 84}]) == readability.loosened(versions, [])
    assert not readability.loosened(versions, [reason])


def test_limits_that_were_raised_in_a_commit_are_found(tmp_path: Path) -> None:
    def commit(limit: int) -> None:
        (tmp_path / "scripts" / readability.SETTINGS.name).write_text(json.dumps({"limits": {"product lines": limit}}))
        for words in (["add", "."], ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "x"]):
            subprocess.run(["git", *words], cwd=tmp_path, check=True)

    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    (tmp_path / "scripts").mkdir()
    commit(50)
    (tmp_path / "scripts" / readability.RAISED.name).write_text("[]\n")
    commit(40)
    commit(45)
    assert [each["product lines"] for each in readability.limit_versions(tmp_path)] == [40, 45, 45]


def test_lines_of_the_product_its_core_and_of_test_beds_are_counted_apart(tmp_path: Path) -> None:
    files = "gdp/a.py scripts/b.sh netns_tests/lab.py netns_tests/test_lab.py tests/c.py docs/d.md gdp_extensions/e.py"
    names = files.split()
    for lines, name in enumerate(names, 1):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x\n" * lines)
    assert readability.line_counts([tmp_path / name for name in names], tmp_path) == (1 + 7, 1, 2 + 3)


def test_seconds_large_classes_and_long_constructors_are_counted() -> None:
    methods = "".join(f"    def m{at}(self): ...\n" for at in range(30))
    tree = ast.parse(
        f"WAIT_S = 1.0\n_REST_S: Final = 2.0\nRESTS = 3\nclass A:\n{methods}"
        "class B:\n    def __init__(self, a, b, c, d, e, f, g, h, *, i): ...\n"
        "class C:\n    def __init__(self, a, b, c, d, e, f, g, h): ...\n"
    )
    assert list(readability.shape_counts([tree]).values()) == [2, 1, 1]


def test_each_exception_has_a_reason() -> None:
    for each in json.loads(readability.SETTINGS.read_text())["allowed"]:
        assert re.search(r"\w", each["reason"])
