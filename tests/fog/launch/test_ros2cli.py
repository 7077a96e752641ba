"""Against a stand-in of ``ros2cli`` (``ros2/README.md``)."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

import pytest

VERBS = ("cost", "down", "launch", "logs", "ls", "plan", "scale", "ssh", "status")
ENTRY_POINTS = {
    "ros2cli.command": {"fog": "fog.ros2cli.command:FogCommand"},
    "ros2cli.extension_point": {"fog.verb": "fog.ros2cli.verb:VerbExtension"},
    "fog.verb": {verb: f"fog.ros2cli.verb:{verb.capitalize()}Verb" for verb in VERBS},
}


@pytest.fixture
def said(ros2: None, monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Return what the ``fog`` command is given."""
    words: list[list[str]] = []
    app = ModuleType("fog.cli.app")
    app.main = words.append  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "fog.cli.app", app)
    monkeypatch.setattr(importlib.import_module("ros2cli"), "ENTRY_POINTS", ENTRY_POINTS)
    monkeypatch.setattr(sys, "argv", ["ros2"])
    return words


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
def test_every_word_reaches_the_fog_command(said: list[list[str]], words: list[str]) -> None:
    assert importlib.import_module("ros2cli.command").ros2(["fog", *words]) == 0
    assert said == [words]


def test_all_verbs_are_there_and_say_what_they_do(said: list[list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    assert importlib.import_module("ros2cli.command").ros2(["fog"]) == 0
    shown = capsys.readouterr().out
    verbs = importlib.import_module("fog.ros2cli.verb")
    for verb in VERBS:
        assert f"{verb}: " in shown
        assert getattr(verbs, f"{verb.capitalize()}Verb").__doc__
    assert said == []
