"""``ros2 fog`` with a stand-in of ``ros2cli``, or the real package (``ros2/README.md``)."""

from __future__ import annotations

import importlib
import re
import sys
from importlib import metadata
from types import ModuleType

import pytest

from tests.pages import ROOT

VERBS = (
    *("cost", "down", "launch", "local", "logs", "ls", "plan", "prices", "scale", "ssh", "status"),
    "supervise",
    "wheels",
)


@pytest.fixture
def said(ros2: None, monkeypatch: pytest.MonkeyPatch) -> list[tuple[list[str], str]]:
    """Return the arguments of the ``fog`` command and its program name."""
    words: list[tuple[list[str], str]] = []
    app = ModuleType("fog.cli.app")
    app.main = lambda given, *, name: words.append((given, name))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "fog.cli.app", app)
    monkeypatch.setattr(sys, "argv", ["ros2"])
    monkeypatch.setattr(metadata, "entry_points", stated_entry_points)
    return words


def stated_entry_points() -> metadata.EntryPoints:
    """Return the statement of pyproject.toml; the installed package may be older."""
    found, group = [], ""
    for line in (ROOT / "pyproject.toml").read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            match = re.fullmatch(r'\[project\.entry-points\."(.+)"\]', line)
            group = match[1] if match else ""
        elif group and line:
            name, value = (word.strip().strip('"') for word in line.split("="))
            found.append(metadata.EntryPoint(name, value, group))
    return metadata.EntryPoints(found)


def run_ros2(*words: str) -> object:
    sys.argv[1:] = words
    return importlib.import_module("ros2cli.cli").main()


@pytest.mark.parametrize(
    "words",
    [
        ["scale", "up", "2", "--json"],
        ["launch", "--dry-run", "x.launch.py", "rate:=5"],
        ["plan", "--target", "0.0005"],
        ["ls", "--help"],
        ["down", "--all"],
        ["ls"],
    ],
)
def test_every_word_reaches_the_fog_command(said: list[tuple[list[str], str]], words: list[str]) -> None:
    assert run_ros2("fog", *words) in (0, None)
    assert said == [(words, "ros2 fog")]


def test_all_verbs_are_there_and_say_what_they_do(
    said: list[tuple[list[str], str]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_ros2("fog") == 0
    shown = capsys.readouterr().out
    verbs = importlib.import_module("fog.ros2cli.verb")
    for verb in VERBS:
        assert re.search(rf"\b{verb}\s", shown)
        assert getattr(verbs, f"{verb.capitalize()}Verb").__doc__
    assert said == []


def test_ros2_launch_puts_launch_files_under_watch_before_it_loads_one(ros2: None) -> None:
    importlib.import_module("fog.ros2cli.option").FogOption().prestart(None)
    loader = importlib.import_module("launch.launch_description_sources.python_launch_file_utilities")
    assert hasattr(loader.load_python_launch_file_as_module, "__wrapped__")
