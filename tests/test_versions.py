"""Version output of every command and of the library."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from importlib import metadata
from typing import Any

import pytest

import gdp
from gdp import burst
from gdp.cli.version import versioned
from tests.pages import ROOT

_SCRIPTS = metadata.distribution("gdp-ros").entry_points.select(group="console_scripts")
_COMMANDS = {each.name: each.value for each in _SCRIPTS}


def _lines(command: Any, *before: str) -> Iterator[list[str]]:
    """Yield the words of a command and of every command below it."""
    yield [*before]
    for name, each in getattr(command, "commands", {}).items():
        yield from _lines(each, *before, name)


@pytest.mark.parametrize("name", sorted(_COMMANDS))
def test_every_command_below_it_knows_h_and_version(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    command = versioned(importlib.import_module(_COMMANDS[name].split(":")[0]).app)
    for words in _lines(command):
        for option, text in (("-h", f"Usage: {' '.join([name, *words])}"), ("--version", metadata.version("gdp-ros"))):
            with pytest.raises(SystemExit) as ended:
                command(args=[*words, option], prog_name=name)
            assert (ended.value.code, text in capsys.readouterr().out) == (0, True)


@pytest.mark.parametrize("command", sorted(_COMMANDS))
def test_a_command_prints_its_version_and_ends(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module, function = _COMMANDS[command].split(":")
    monkeypatch.setattr(sys, "argv", [command, "--version"])
    with pytest.raises(SystemExit) as ended:
        getattr(importlib.import_module(module), function)()
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"{command} {metadata.version('gdp-ros')}\nburst core: {burst.VARIANT}\n"


def test_the_library_has_the_version_of_its_distribution() -> None:
    assert gdp.__version__ == metadata.version("gdp-ros")


def test_everything_that_the_library_exports_can_be_imported() -> None:
    for name in gdp.__all__:
        assert getattr(gdp, name) is not None


def test_every_file_that_states_the_version_has_that_of_the_distribution() -> None:
    stated = {
        "CHANGELOG.md": r"^## \[(\d[^]]*)\] - \d{4}-\d\d-\d\d$",
        "CITATION.cff": r"^version: (\S+)$",
        "debian/changelog": r"^gdp-ros \((\S+)\)",
        "pyproject.toml": r'^version = "(\S+)"$',
        "ros2/gdp_proxy/package.xml": r"<version>(\S+)</version>",
    }
    for name, pattern in stated.items():
        newest, *_ = re.findall(pattern, (ROOT / name).read_text(), re.MULTILINE)
        assert newest == metadata.version("gdp-ros"), name


def test_the_changelog_has_the_kinds_of_changes_of_keep_a_changelog() -> None:
    kinds = set(re.findall(r"^### (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE))
    assert kinds <= {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
