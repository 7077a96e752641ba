"""JSON schema of proxy.yaml, for editors."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from typer.testing import CliRunner

from proxy.cli.proxy import Schema, schema_text
from proxy.config.config import DIALECT, ProxyConfig
from tests.proxy.rule_files import NODE, rules
from tests.proxy.test_rules import BAD, GOOD

COMMITTED = Path(__file__).parents[3] / "docs" / "proxy.schema.json"


def _sections(schema: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    yield "proxy.yaml", schema
    yield from schema["$defs"].items()


def test_the_committed_schema_is_the_models() -> None:
    assert json.loads(COMMITTED.read_text()) == ProxyConfig.json_schema(), "gdp-proxy --schema > docs/proxy.schema.json"


def test_every_key_is_described_and_no_other_is_known() -> None:
    schema = ProxyConfig.json_schema()
    assert schema["$schema"] == DIALECT
    for title, section in _sections(schema):
        assert section["additionalProperties"] is False
        for key, value in section["properties"].items():
            assert value.get("description", "").endswith("."), f"{title}: {key}"


def test_the_keys_are_those_of_the_file_and_not_those_of_the_code() -> None:
    schema: dict[str, Any] = ProxyConfig.json_schema()
    assert {"ros", "expose", "import", "record"} <= schema["properties"].keys()
    assert {"type", "reliable", "latched", "global"} <= schema["$defs"]["Rule"]["properties"].keys()


def test_patterns_are_such_as_every_editor_reads() -> None:
    """ECMAScript has no ``\\Z``, no named or possessive groups as Python writes them."""
    for found in re.findall(r'"pattern": "(.*)"', schema_text()):
        pattern = json.loads(f'"{found}"')
        assert pattern[0] == "^"
        assert pattern[-1] == "$"
        assert not re.search(r"\\[ZA]|\(\?P|[*+?]\+", pattern)


def test_the_option_prints_the_schema_before_a_configuration_is_asked_for() -> None:
    app = typer.Typer()

    @app.command()
    def command(config: str, schema: Schema = False) -> None: ...

    shown = CliRunner().invoke(app, ["--schema"])
    assert shown.exit_code == 0
    assert shown.output == schema_text() == COMMITTED.read_text()


def _accepts(text: str) -> bool:
    jsonschema = pytest.importorskip("jsonschema", reason="the jsonschema package is not installed")
    return bool(jsonschema.Draft202012Validator(ProxyConfig.json_schema()).is_valid(yaml.safe_load(NODE + text)))


def _with_rule(text: str) -> str:
    return f"ros: {{endpoint: ros2}}\nexpose:\n{rules(text)}"


def test_an_editor_takes_the_good_rules_and_underlines_the_bad() -> None:
    assert [text for text in GOOD if not _accepts(_with_rule(text))] == []
    of_two_keys = [  # left to the command
        "name: /a/*, remap: /b",
        "name: /a, compress: {dictionary: none}",
        "name: /a, type: std_msgs/msg/String, image: png",
        "name: /a, image: png, quality: 5",
        "name: /a, type: sensor_msgs/msg/Image, voxel_m: 1",
        "name: /a, region: {x: [2, 1]}",
        "name: /a, adapt: {min_hz: 5, max_hz: 2}",
    ]
    assert [text for text, _ in BAD if _accepts(_with_rule(text))] == of_two_keys


def test_an_editor_knows_that_the_file_may_state_the_owner_for_its_rules() -> None:
    ownerless = "ros: {endpoint: ros2}\nexpose:\n  - {name: /a}\n"
    assert _accepts(f"owner: owner.pub\n{ownerless}")
    assert not _accepts(ownerless)


def test_an_editor_knows_the_other_keys_too() -> None:
    good = ["", "ros: [{endpoint: ros2, domain: 1}, {endpoint: ros1, master: 'http://a:1'}]", "ros: {endpoint: dds}"]
    bad = ["ros: 2", "ros: {endpoint: zenoh}", "record: {path: x, format: bag}", "metrics: {}", "exposes: []"]
    assert [text for text in [*good, *bad] if _accepts(text)] == good
