"""Completion in real shells: bash, zsh and fish complete the words of our commands."""

from __future__ import annotations

import os
import pty
import re
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import pytest

from gdp.cli.completion import PROGRAMS, Shell, complete_node, completion_script
from gdp.stores.keyring import NODE_CERTIFICATE
from tests.pages import ROOT

PATIENCE_S = 15.0
BASH = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMP_LINE="$*"; COMP_POINT=${#COMP_LINE}
spec=$(complete -p "$1") && function=${spec##*-F } && "${function%% *}" "$1" "${COMP_WORDS[COMP_CWORD]}" ""
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, str]:
    """Return an environment in which our programs are on the path."""
    folder = tmp_path_factory.mktemp("bin")
    modules = {
        "gdp": "gdp.cli.gdp",
        "gdp-switch": "gdp.cli.switch",
        "gdp-proxy": "proxy.cli.proxy",
        "fog": "fog.cli.app",
    }
    for name, module in modules.items():
        path = folder / name
        path.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m {module} "$@"\n')
        path.chmod(0o755)
    home = tmp_path_factory.mktemp("home")
    return {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}", "HOME": str(home), "TERM": "xterm"}


def script_file(folder: Path, shell: Shell) -> Path:
    """Return a file with a shell's script."""
    path = folder / f"completion.{shell.value}"
    path.write_text(completion_script(shell))
    return path


def test_every_program_of_the_package_is_completed() -> None:
    text = (ROOT / "pyproject.toml").read_text().partition("[project.scripts]\n")[2].partition("\n\n")[0]
    assert sorted(PROGRAMS) == sorted(line.partition(" = ")[0] for line in text.splitlines())


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["gdp", "topic", "e"], ["echo"]),
        (["gdp", "topic", "echo", "--tr"], ["--truncate-length"]),
        (["gdp", "rule", "a"], ["add"]),
        (["gdp", "completion", ""], ["bash", "zsh", "fish"]),
        (["gdp-switch", "--if"], ["--iface"]),
        (["gdp-proxy", "--aw"], ["--await-iface"]),
        (["fog", "la"], ["launch"]),
    ],
)
def test_bash_completes_a_word(
    words: list[str], expected: list[str], programs: Mapping[str, str], tmp_path: Path
) -> None:
    script = script_file(tmp_path, Shell.BASH)
    done = subprocess.run(
        ["bash", "--norc", "-c", BASH, "bash", str(script), *words],
        capture_output=True, text=True, timeout=PATIENCE_S, env=programs, check=True,
    )  # fmt: skip
    assert sorted(done.stdout.split()) == sorted(expected), done.stderr


def test_bash_completes_in_a_terminal(programs: Mapping[str, str], tmp_path: Path) -> None:
    script = script_file(tmp_path, Shell.BASH)
    assert "gdp topic info " in _typed(["bash", "--norc", "-i"], f"source {script}\n", "gdp topic in\t", programs)


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
def test_zsh_completes_in_a_terminal(programs: Mapping[str, str], tmp_path: Path) -> None:
    script = script_file(tmp_path, Shell.ZSH)
    set_up = f"autoload -Uz compinit; compinit -u -D; source {script}\n"
    assert "gdp topic info " in _typed(["zsh", "-f", "-i"], set_up, "gdp topic in\t", programs)


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
def test_zsh_loads_the_script_from_its_function_path(programs: Mapping[str, str], tmp_path: Path) -> None:
    (tmp_path / "_gdp").write_text(completion_script(Shell.ZSH))
    set_up = f"fpath+={tmp_path}; autoload -Uz compinit; compinit -u -D\n"
    assert "gdp-switch --iface " in _typed(["zsh", "-f", "-i"], set_up, "gdp-switch --if\t", programs)


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
@pytest.mark.parametrize(("line", "expected"), [("gdp topic in", "info"), ("gdp-switch --if", "--iface")])
def test_fish_completes_a_word(line: str, expected: str, programs: Mapping[str, str], tmp_path: Path) -> None:
    script = script_file(tmp_path, Shell.FISH)
    done = subprocess.run(
        ["fish", "--no-config", "-c", f"source {script}; complete --do-complete '{line}'"],
        capture_output=True, text=True, timeout=PATIENCE_S, env=programs, check=True,
    )  # fmt: skip
    assert [row.partition("\t")[0] for row in done.stdout.splitlines()] == [expected], done.stderr


def test_the_directories_of_nodes_are_offered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("keys/viewer", "keys/robot", "kiosk", "plain"):
        (tmp_path / folder).mkdir(parents=True)
    for folder in ("keys/viewer", "keys/robot", "kiosk"):
        (tmp_path / folder / NODE_CERTIFICATE).touch()
    monkeypatch.chdir(tmp_path)
    assert complete_node("k") == ["keys/robot", "keys/viewer", "kiosk"]
    assert complete_node("keys/v") == ["keys/viewer"]
    assert complete_node(f"{tmp_path}/ki") == [f"{tmp_path}/kiosk"]


def _typed(shell: list[str], set_up: str, keys: str, environment: Mapping[str, str]) -> str:
    """Return what a shell shows after these keys, or as soon as the completed word is there."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        shell, stdin=theirs, stdout=theirs, stderr=theirs, env=dict(environment), start_new_session=True
    )
    os.close(theirs)
    shown = ""
    try:
        os.write(ours, set_up.encode() + b"echo re''ady\n")
        end_s = time.monotonic() + PATIENCE_S
        is_typed = False
        while time.monotonic() < end_s:
            if not select.select([ours], [], [], 0.5)[0]:
                continue
            shown += os.read(ours, 1 << 16).decode(errors="replace")
            if "ready\r\n" in shown and not is_typed:
                is_typed, shown = True, ""
                os.write(ours, keys.encode())
            if is_typed and any(word in _plain(shown) for word in ("gdp topic info ", "gdp-switch --iface ")):
                break
    finally:
        process.kill()
        process.wait(PATIENCE_S)
        os.close(ours)
    return _plain(shown)


def _plain(shown: str) -> str:
    """Return a terminal's text without its control sequences, with erased characters removed."""
    text = re.sub(r"\x1b(\[[0-9;?]*[A-Za-z]|[=>])", "", shown)
    while "\x08" in text:
        text = re.sub("[^\x08]?\x08", "", text, count=1)
    return text
