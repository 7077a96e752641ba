"""``ros2 gdp`` with a stand-in of ``ros2cli``, or the real package (``ros2/README.md``)."""

from __future__ import annotations

import importlib
import sys
from importlib import metadata
from types import ModuleType

import pytest

from tests.fog.launch.test_ros2cli import run_ros2, stated_entry_points
from tests.pages import ROOT


@pytest.fixture
def said(ros2: None, monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Return the arguments of the ``gdp`` command and of ``gdp-switch``."""
    words: list[list[str]] = []
    gdp, switch = ModuleType("gdp.cli.gdp"), ModuleType("gdp.cli.switch")
    gdp.main = words.append  # type: ignore[attr-defined]
    switch.main = lambda: words.append(list(sys.argv))  # type: ignore[attr-defined]
    for module in (gdp, switch):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(sys, "argv", ["ros2"])
    monkeypatch.setattr(metadata, "entry_points", stated_entry_points)
    return words


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["name", "--kind", "topic", "--help"], ["name", "--kind", "topic", "--help"]),
        (["key", "show", "robot"], ["key", "show", "robot"]),
        (["switch", "--config", "x.yaml"], ["gdp-switch", "--config", "x.yaml"]),
        ([], ["--help"]),
    ],
)
def test_every_word_reaches_the_command(said: list[list[str]], words: list[str], wanted: list[str]) -> None:
    assert run_ros2("gdp", *words) in (0, None)
    assert said == [wanted]


def test_every_program_is_there(ros2: None) -> None:
    scripts = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for module, program in importlib.import_module("proxy.ros2cli.command").PROGRAMS.values():
        assert f'{program} = "{module}:main"' in scripts
        assert callable(importlib.import_module(module).main)
