"""Commands of ``gdp`` are imported when they are used."""

from __future__ import annotations

import subprocess
import sys

import pytest

from gdp.cli.gdp import app
from gdp.cli.lazy_commands import LazyCommand, LazyCommands
from gdp.cli.version import versioned
from gdp.crypto.certificates import Role
from gdp.management.running_nodes import _ROLES

_IMPORTED = """
import sys
from gdp.cli.gdp import main
try:
    main(["name", "--help"])
finally:
    print(*sorted(each for each in sys.modules if each.startswith("gdp")), file=sys.stderr)
"""


def test_one_command_does_not_import_the_others() -> None:
    done = subprocess.run([sys.executable, "-c", _IMPORTED], capture_output=True, text=True, timeout=60, check=True)
    imported = done.stderr.split()
    assert "gdp.cli.name" in imported
    assert not {"gdp.cli.topic", "gdp.cli.unit", "gdp_extensions.dashboard", "gdp.config.config"} & {*imported}


def test_a_misspelled_command_is_suggested_without_an_import(capsys: pytest.CaptureFixture[str]) -> None:
    command = versioned(app)
    with pytest.raises(SystemExit) as ended:
        command(args=["pinf", "/scan"], prog_name="gdp")
    assert ended.value.code == 2
    assert "Did you mean 'ping'?" in capsys.readouterr().err
    assert command.commands.loaded == {}  # type: ignore[attr-defined]


def test_lazy_commands_are_a_mapping_in_the_order_of_the_help() -> None:
    known = {each: LazyCommand(f"gdp.cli.{each}:{each}", "") for each in ("trace", "ping")}
    commands = LazyCommands(known)
    assert [*commands] == ["trace", "ping"]
    assert commands["ping"] is commands["ping"]
    assert commands["ping"].name == "ping"
    commands["more"] = commands["ping"]
    assert [*commands] == ["trace", "ping", "more"]
    del commands["trace"]
    assert ("trace" in commands, len(commands)) == (False, 2)
    for missing in "trace", "pinf":
        with pytest.raises(KeyError):
            commands[missing]
        with pytest.raises(KeyError):
            del commands[missing]


def test_the_roles_of_running_nodes_are_those_of_memberships() -> None:
    assert {each.value for each in Role} == _ROLES
