"""Errors of every command have one form, those of usage too: ``error: ...`` on standard error, exit code 2."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import typer
from typer.core import TyperGroup

from gdp.cli.version import versioned
from tests.test_docs import APPS

PROGRAMS = ("gdp", "gdp-switch", "gdp-relay", "gdp-rib", "gdp-proxy", "gdp-delegate", "gdp-replay", "fog")


def paths(command: object, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield each command and group below one that refuses unknown options."""
    if isinstance(command, TyperGroup):
        yield path
        context = typer.Context(command)
        for name in command.list_commands(context):
            yield from paths(command.get_command(context, name), (*path, name))
    elif not getattr(command, "ignore_unknown_options", False) and not command.context_settings.get(  # type: ignore[attr-defined]
        "ignore_unknown_options"
    ):
        yield path


ALL = [path for program in PROGRAMS for path in paths(typer.main.get_command(APPS[program]), (program,))]


@pytest.mark.parametrize("path", ALL, ids=" ".join)
def test_an_option_that_does_not_exist_is_an_error_of_the_common_form(
    path: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        versioned(APPS[path[0]])(args=[*path[1:], "--no-such-option"], prog_name=path[0])
    out, err = capsys.readouterr()
    first, hint = err.splitlines()
    assert (ended.value.code, out) == (2, "")
    assert first.startswith("error: No such option: --no-such-option")
    assert hint.startswith(f"Try '{' '.join(path)} ")


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("gdp nope", "error: No such command 'nope'"),
        ("gdp name", None),
        ("gdp show links --last x", "error: "),
        ("gdp-switch --config", "error: Option '--config' requires an argument."),
        ("gdp share --days x", "error: Invalid value for '--days': "),
    ],
)
def test_what_is_missing_or_invalid_is_an_error_of_the_common_form_and_no_arguments_are_the_help(
    line: str, error: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    program, *words = line.split()
    with pytest.raises(SystemExit) as ended:
        versioned(APPS[program])(args=words, prog_name=program)
    out, err = capsys.readouterr()
    if error is None:
        assert "Usage: gdp name" in out + err
    else:
        assert ended.value.code == 2
        assert err.startswith(error)
        assert "\u2500" not in err
        assert "Input should be" not in err
