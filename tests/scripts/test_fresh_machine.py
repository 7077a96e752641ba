"""Commands that a page tells a person to type: read from its blocks, each with its machine."""

from __future__ import annotations

from lab.internet.fresh_machine import TypedCommand, typed_commands
from tests.pages import ROOT


def test_only_blocks_that_name_a_machine_are_typed_there() -> None:
    page = "```text\nsetup.sh\n```\n\n```bash\n# on the robot\n\ngdp expose '/a' --to b  # a remark\n# more\n```\n"
    assert typed_commands(page) == [TypedCommand("robot", "gdp expose '/a' --to b")]


def test_the_tutorial_needs_three_commands_and_two_and_edits_no_file() -> None:
    found = typed_commands((ROOT / "docs/tutorials/internet.md").read_text(encoding="utf-8"))
    assert [each.machine for each in found] == ["border", "robot", "server", "robot", "server"]
    assert all(each.text.startswith("gdp ") for each in found)
