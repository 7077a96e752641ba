"""Version output of every command and of the library."""

from __future__ import annotations

import importlib
import sys
from importlib import metadata

import pytest

import gdp

_SCRIPTS = metadata.distribution("gdp-ros").entry_points.select(group="console_scripts")
_COMMANDS = {each.name: each.value for each in _SCRIPTS}


@pytest.mark.parametrize("command", sorted(_COMMANDS))
def test_a_command_prints_its_version_and_ends(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module, function = _COMMANDS[command].split(":")
    monkeypatch.setattr(sys, "argv", [command, "--version"])
    with pytest.raises(SystemExit) as ended:
        getattr(importlib.import_module(module), function)()
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"{command} {metadata.version('gdp-ros')}\n"


def test_the_library_has_the_version_of_its_distribution() -> None:
    assert gdp.__version__ == metadata.version("gdp-ros")


def test_everything_that_the_library_exports_can_be_imported() -> None:
    for name in gdp.__all__:
        assert getattr(gdp, name) is not None
