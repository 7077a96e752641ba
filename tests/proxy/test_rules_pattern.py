"""Full names and patterns of them."""

from __future__ import annotations

import pytest

from gdp.ros_names import NAME_MAX_CHARS, is_name, is_pattern, matches


@pytest.mark.parametrize("text", ["/a", "/camera/image_raw", "/_hidden", "/fold/_action/status", "/1", "/" + "a" * 511])
def test_a_full_name_is_one(text: str) -> None:
    assert is_name(text)
    assert not is_pattern(text)


@pytest.mark.parametrize(
    "text",
    ["", "/", "a", "a/b", "/a/", "//a", "/a//b", "/a b", "/a-b", "/ä", "~a", "/~a", "/{a}", "/a\n", "/a." + "a" * 512],
)
def test_what_ros_would_not_call_anything_is_neither_name_nor_pattern(text: str) -> None:
    assert not is_name(text)
    assert not is_pattern(text)


@pytest.mark.parametrize("text", ["/*", "/**", "/camera/*", "/a/**/image", "/cam*/im*e", "/*_raw", "/_*", "/a/**/b/*"])
def test_a_pattern_is_one(text: str) -> None:
    assert is_pattern(text)
    assert not is_name(text)


@pytest.mark.parametrize("text", ["*", "**", "/***", "/a**", "/**a", "/a**b", "/a/**b", "/*/", "//*", "/?", "/[ab]*"])
def test_stars_that_mean_nothing_are_refused(text: str) -> None:
    assert not is_pattern(text)


def test_a_long_text_is_refused_at_once() -> None:
    assert not is_pattern("/" + "a*" * 10_000)
    assert not is_pattern("/" + "a*" * (NAME_MAX_CHARS // 2 - 1) + "!")


@pytest.mark.parametrize(
    ("pattern", "meant", "not_meant"),
    [
        ("/camera/*", ["/camera/image", "/camera/info"], ["/camera", "/camera/left/image", "/cameras/image"]),
        ("/camera/**", ["/camera/image", "/camera/left/image"], ["/camera", "/other/camera/image"]),
        ("/**", ["/a", "/a/b/c"], []),
        ("/**/image", ["/left/image", "/robot/left/image"], ["/image", "/left/image/raw"]),
        ("/cam*/image", ["/cam/image", "/camera/image"], ["/camera/left/image", "/cam/images"]),
        ("/*_raw", ["/image_raw", "/a_raw"], ["/image_raws", "/image/raw"]),
        ("/a*c*e", ["/ace", "/abcde"], ["/ac", "/a/c/e"]),
    ],
)
def test_a_pattern_means_these_names_and_not_those(pattern: str, meant: list[str], not_meant: list[str]) -> None:
    assert [name for name in [*meant, *not_meant] if matches(pattern, name)] == meant


@pytest.mark.parametrize("pattern", ["/**", "/fold/**", "/fold/*/status", "/*/*/status"])
def test_a_star_does_not_begin_a_hidden_segment(pattern: str) -> None:
    assert not matches(pattern, "/fold/_action/status")


@pytest.mark.parametrize("pattern", ["/fold/_action/*", "/fold/_*/status", "/**/_action/status"])
def test_a_hidden_segment_that_is_written_out_is_meant(pattern: str) -> None:
    assert matches(pattern, "/fold/_action/status")
