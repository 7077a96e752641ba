"""Paths in configuration files that the system does not accept."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.errors import ConfigError
from proxy.config.config import ProxyConfig


@pytest.mark.parametrize("path", ["x" * 5_000, "~no-user-of-this-name/x", "a/" * 3_000, '"\\0"'])
def test_a66_a_path_that_cannot_be_is_an_error_of_the_configuration(tmp_path: Path, path: str) -> None:
    file = tmp_path / "proxy.yaml"
    file.write_text(f"identity: {path}\ndomain: {{root: {path}}}\niface: a\ndelegations: {path}\n")
    with pytest.raises(ConfigError):
        ProxyConfig.load(file)
