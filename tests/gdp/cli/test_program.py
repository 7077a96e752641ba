"""Frame of programs: groups of options, and the exit code of an error."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import pytest
import typer

from gdp.cli.program import Program
from gdp.errors import LocalError


class Size(NamedTuple):
    """Options of a size."""

    width: Annotated[int, typer.Option("--width")] = 2
    height: Annotated[int, typer.Option("--height")] = 3


def _program() -> Program:
    program = Program("sizes")

    @program.command()
    def area(name: str, *, size: Size, is_loud: Annotated[bool, typer.Option("--loud")] = False) -> None:
        if size.width < 0:
            raise LocalError("a width is positive")
        typer.echo(f"{name} {size.width * size.height} {is_loud}")

    return program


def test_a_group_of_options_is_given_option_by_option(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        _program().run(["door", "--height", "4", "--loud"])
    assert (ended.value.code, capsys.readouterr().out) == (0, "door 8 True\n")


def test_an_error_of_ours_is_one_line_and_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        _program().run(["door", "--width", "-1"])
    assert (ended.value.code, capsys.readouterr().err) == (2, "error: a width is positive\n")
