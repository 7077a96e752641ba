"""Permitted content of a YAML file, and errors that point into it."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gdp.config.yaml_source import Plain, YamlSource, read_yaml
from gdp.errors import ConfigError


def read(folder: Path, text: str) -> YamlSource:
    path = folder / "file.yaml"
    path.write_text(text, encoding="utf-8")
    return read_yaml(path)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("true", True),
        ("null", None),
        ("~", None),
        ("", None),
        ("12", 12),
        ("-7", -7),
        ("0x1f", 31),
        ("1.5", 1.5),
        ("1e3", 1000.0),
        ("yes", "yes"),
        ("off", "off"),
        ("12:30", "12:30"),
        ("2024-01-01", "2024-01-01"),
        ("'12'", "12"),
        ('"true"', "true"),
        ("010", 10),
        ("/camera/image", "/camera/image"),
    ],
)
def test_an_unquoted_word_means_what_yaml_1_2_says(tmp_path: Path, text: str, value: Plain) -> None:
    assert read(tmp_path, f"key: {text}\n").data == {"key": value}


def test_every_key_and_value_has_its_place(tmp_path: Path) -> None:
    source = read(tmp_path, "a:\n  - b: 1\n")
    assert source.keys[("a", 0, "b")] == (2, 5)
    assert source.values[("a", 0, "b")] == (2, 8)


def test_an_empty_file_holds_no_keys(tmp_path: Path) -> None:
    assert read(tmp_path, "# nothing\n").data == {}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a: 1\nb: 2\na: 3\n", "3:1: a: stands twice; first in line 1"),
        ("a: &x 1\n", "1:4: anchors and aliases are not accepted"),
        ("a: *x\n", "1:4: anchors and aliases are not accepted"),
        ("a: !!python/name:os 1\n", "1:4: tags such as tag:yaml.org,2002:python/name:os are not accepted"),
        ("? [a]\n: 1\n", "1:3: a key is a text"),
        ("a: [1, 2\n", "2:1: YAML is expected: did not find expected ',' or ']'"),
        ("a: 1\n--- \nb: 1\n", "2:1: YAML is expected: but found another document"),
        ("[" * 100, "1:33: nested deeper than 32"),
    ],
)
def test_unaccepted_input_is_reported_with_its_position(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, text)
    assert str(caught.value) == f"{tmp_path}/file.yaml:{complaint}"


def test_bytes_that_are_not_utf_8_are_reported_with_their_line(tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_bytes(b"a: 1\nb: \xff\n")
    with pytest.raises(ConfigError, match=r"file\.yaml:2: UTF-8 text is expected"):
        read_yaml(path)


def test_a_file_without_end_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="at most 1048576 bytes"):
        read_yaml(Path("/dev/zero"))


@given(raw=st.binary(max_size=60) | st.text("[]{}:-#&*!|>'\" \n\tab1.", max_size=60).map(str.encode))
@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_arbitrary_bytes_are_read_or_refused(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "file.yaml"
    path.write_bytes(raw)
    try:
        source = read_yaml(path)
    except ConfigError:
        return
    assert () in source.values
