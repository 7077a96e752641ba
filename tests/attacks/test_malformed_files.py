"""Malformed files of fog: each error is the project's own, and names the file."""

from __future__ import annotations

import contextlib
import json
import sqlite3
import tracemalloc
from pathlib import Path

import pytest

from fog.cluster import ClusterPlan
from fog.host.bundle import read_programs
from fog.host.preemption_notice import read_notice
from fog.host.status import Status
from fog.launch.cloud_node import parameter_rule, parameters_in
from fog.launch.load import load
from fog.providers.local.machine_file import MachineFile
from fog.supervisor.journal import Journal
from gdp.config.yaml_source import read_yaml
from gdp.errors import ConfigError, GdpError, LocalError, StoreError
from tests.attacks.work import lines_run

DEEP = b"[" * 200_000
BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 10)}]\n" for old, new in zip("abcdefg", "bcdefgh", strict=True)
)
NO_JSON = [b"", b"{", b"[]", b"null", b"3", b'"x"', b"\xff\xfe", DEEP, b'{"state": [], "programs": 3}']


def test_a59_a_parameter_file_that_unrolls_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "parameters.yaml"
    path.write_text(BOMB)
    assert path.stat().st_size < 700
    with pytest.raises(LocalError, match=rf"{path}:2: aliases are not accepted"):
        parameters_in(path, "node", None)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"#" * ((1 << 20) + 1), "at most 1048576"),
        (b"a:\n  b: \xff\n", r":2: UTF-8"),
        (b"a: [1\nb: 2\n", r":2: YAML"),
        (b"a: 2001-99-99\n", "YAML is expected"),
        (b"a: " + b"[" * 100, r":1: nested deeper"),
        (b"n: {ros__parameters: {a: 0x" + b"f" * 20_000 + b"}}", "64 bits"),
        (b"n: {ros__parameters: {a: " + b"9" * 20_000 + b"}}", "YAML is expected|64 bits"),
        (b'n: {ros__parameters: {"a\\0": 1}}', "zero byte"),
        (b'n: {ros__parameters: {a: "\\ud800"}}', "surrogate|invalid Unicode"),
    ],
    ids=["long", "bytes", "syntax", "date", "deep", "hex", "digits", "zero", "surrogate"],
)
def test_a59_a_parameter_file_that_is_none_is_named(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "parameters.yaml"
    path.write_bytes(content)
    with pytest.raises(LocalError, match=says):
        parameters_in(path, "n", None)


def test_a59_a_rule_that_unrolls_is_refused() -> None:
    with pytest.raises(LocalError, match="aliases are not accepted"):
        parameter_rule("a:=[&a !!python/tuple [1], *a]")


@pytest.mark.parametrize("content", NO_JSON)
def test_a_plan_that_is_none_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "plan.json"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=str(path)):
        load(path, {})


def test_a_plan_that_is_no_json_is_named_with_its_line() -> None:
    with pytest.raises(LocalError, match="line 2"):
        ClusterPlan.from_json('{\n"name": }')


def test_a_launch_file_that_ends_the_program_is_named_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "x.launch.py"
    path.write_text("import sys\nsys.exit(7)\n")
    with pytest.raises(ConfigError, match=rf"{path}:2: SystemExit"):
        load(path, {})


@pytest.mark.parametrize("content", NO_JSON)
def test_files_of_a_machine_that_are_none_say_nothing(tmp_path: Path, content: bytes) -> None:
    for name in ("machine.json", "status.json", "notice.json"):
        (tmp_path / name).write_bytes(content)
    assert MachineFile.read(tmp_path) is None
    assert Status.read(tmp_path) is None
    assert read_notice(tmp_path) is None


@pytest.mark.parametrize("moment", ["1e999", "NaN", "-Infinity", "1" * 400])
def test_a_notice_of_no_moment_is_none(tmp_path: Path, moment: str) -> None:
    (tmp_path / "notice.json").write_text(f'{{"leaves_at_unix_s": {moment}}}')
    assert read_notice(tmp_path) is None


@pytest.mark.parametrize(
    "content",
    [
        *NO_JSON,
        b'{"programs": [{"name": "x", "argv": []}]}',
        b'{"programs": [{"name": "x", "argv": [3]}]}',
        b'{"programs": [{"name": "x", "argv": ["a\\u0000"]}]}',
        b'{"programs": [{"name": "x", "argv": ["a"], "environment": null}]}',
    ],
)
def test_a_boot_that_is_none_is_named(content: bytes) -> None:
    with pytest.raises(LocalError, match=r"boot\.json"):
        read_programs(content)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", "3", DEEP.decode(), '{"spec": {}, "wanted": {}, "issued_credentials": {}}']
)
def test_a_row_of_the_journal_that_is_none_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "journal.sqlite3"
    journal = Journal(path)
    with sqlite3.connect(path) as file:
        file.execute("INSERT INTO machines VALUES ('lab', 'm1', 0, ?)", (text,))
        file.execute("INSERT INTO clusters VALUES ('lab', ?, 1, '', 0.0, 1)", (text,))
    file.close()
    with pytest.raises(StoreError, match=rf"{path}: machines: lab m1"):
        journal.machines("lab")
    with pytest.raises(StoreError, match=rf"{path}: clusters: lab"):
        journal.clusters()
    journal.close()


def test_a_journal_that_is_no_database_is_named(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite3"
    path.write_bytes(json.dumps({"a": 1}).encode() * 100)
    with pytest.raises(GdpError, match=str(path)):
        Journal(path)


def test_b09_a_short_configuration_takes_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("a: 1\n")
    read_yaml(path)
    tracemalloc.start()
    try:
        read_yaml(path)
        assert tracemalloc.get_traced_memory()[1] < 128 << 10
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("opening", ["[", "{", "[a,", "- "])
def test_b08_a_configuration_of_nothing_but_openings_costs_little(tmp_path: Path, opening: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(opening * (8_000 // len(opening)))
    with lines_run(100_000), contextlib.suppress(ConfigError):
        read_yaml(path)
    with lines_run(100_000), contextlib.suppress(LocalError):
        parameters_in(path, "n", "/")
