"""Examples of docs/reference/providers.md can be read, and its tables name the existing keys."""

from __future__ import annotations

from pathlib import Path

import orjson
import pytest
import yaml

from fog.providers.cloud_config import AwsConfig, SkyPilotConfig
from fog.providers.cloud_init import Setup
from gdp.config.schema import Section
from tests.pages import ROOT, blocks

PAGE = ROOT / "docs/reference/providers.md"


def _shown(provider: str) -> object:
    found = [yaml.safe_load(block.text) for block in blocks(PAGE) if block.language == "yaml"]
    return next(each[provider] for each in found if provider in each)


@pytest.mark.parametrize(("provider", "model"), [("aws", AwsConfig), ("skypilot", SkyPilotConfig)])
def test_the_settings_that_are_shown_can_be_read(provider: str, model: type[Section]) -> None:
    read = model.model_validate_json(orjson.dumps(_shown(provider)), strict=True, context={"base": Path()})
    assert read != model()


@pytest.mark.parametrize("model", [AwsConfig, SkyPilotConfig, Setup])
def test_every_key_is_explained(model: type[Section]) -> None:
    text = PAGE.read_text()
    assert [key for key in model.model_fields if f"`{key}`" not in text] == []
