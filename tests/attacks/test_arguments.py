"""Secrets that a command takes, which no other user of the host may read in its arguments."""

from __future__ import annotations

import io
import os
import re
from pathlib import Path
from typing import cast, get_type_hints

import pytest
import typer
from typer.core import TyperGroup
from typer.main import get_command

from gdp.errors import LocalError
from gdp.trust.join_token import JoinToken
from tests.gdp.cli.test_gdp import Run, gdp, leaves
from tests.test_docs import APPS

__all__ = ["gdp"]

TOKEN = "gdp1" + "a" * 200
SECRET = re.compile(r"token|secret|salt|passphrase|password|\bpin\b|\bkey\b", re.I)
NO_SECRET = {
    "argument",  # of gdp join: refused
    "epochs",  # numbers, of secrets
    "key",  # the address of a key: its pin-value is refused
    "uri",  # the same
    "pin",  # a number of the metadata
    "settings",  # of a rule: a salt in its metadata is refused
    "tokens",  # how many
    "valid",  # how long
}


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the texts that ``gdp join`` takes for tokens; it refuses each."""
    found: list[str] = []

    def from_text(text: str) -> JoinToken:
        found.append(text)
        raise LocalError("seen")

    monkeypatch.setattr(JoinToken, "from_text", from_text)
    return found


def test_z01_a_join_token_as_an_argument_is_refused(gdp: Run, seen: list[str]) -> None:
    done = gdp(f"join {TOKEN} --label robot")
    assert (done.code, done.out, seen) == (2, "", [])
    assert all(word in done.err for word in ("--token-file FILE", "--token-file -", "GDP_TOKEN"))
    assert TOKEN not in done.err


def test_z01_a_join_token_comes_from_a_private_file(gdp: Run, seen: list[str]) -> None:
    file = Path("token")
    file.write_text(f"{TOKEN}\n")
    file.chmod(0o644)
    assert "chmod 600" in gdp("join --token-file token").err
    file.chmod(0o600)
    gdp("join --token-file token")
    assert seen == [TOKEN]


def test_z01_a_join_token_comes_from_the_environment_which_no_program_inherits(
    gdp: Run, seen: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GDP_TOKEN", TOKEN)
    gdp("join --label robot")
    assert seen == [TOKEN]
    assert "GDP_TOKEN" not in os.environ


@pytest.mark.parametrize("line", ["join", "join -", "join --token-file -"])
def test_z01_a_join_token_comes_from_standard_input(
    line: str, gdp: Run, seen: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(f"{TOKEN}\n"))
    gdp(line)
    assert seen == [TOKEN]
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    assert "a join token is not empty" in gdp(line).err


def test_z01_a_salt_in_a_setting_of_a_rule_is_refused(gdp: Run, tmp_path: Path) -> None:
    done = gdp("rule add expose /scan --owner o", "--set", "metadata={salt: unguessable}")
    assert (done.code, done.out, list(tmp_path.iterdir())) == (2, "", [])
    assert "--set salt_file=FILE" in done.err
    assert "unguessable" not in done.err


@pytest.mark.parametrize("name", APPS)
def test_z01_no_command_takes_a_secret_as_an_argument(name: str) -> None:
    """A parameter that is said to be a secret is the name of a file, a number or a switch."""
    whole = get_command(APPS[name])
    for path in leaves(whole):
        command = whole
        for word in path:
            found = cast("TyperGroup", command).get_command(typer.Context(command), word)
            assert found is not None
            command = found
        texts = {key for key, hint in get_type_hints(command.callback).items() if "str" in str(hint)}
        said = {each.name: f"{each.name} {each.opts} {getattr(each, 'help', '')}" for each in command.params}
        taken = {key for key in texts & said.keys() if SECRET.search(said[key])}
        assert taken <= NO_SECRET, f"{name} {' '.join(path)}"
