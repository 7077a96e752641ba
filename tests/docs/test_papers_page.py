"""Commands of ``docs/papers.md``: each exists, and each of under a minute is run and shows what the page says."""

from __future__ import annotations

import ast
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from tests.pages import ROOT, Claim, claims

CLAIMS: Final = claims()
_RING, _LIVE = "netns_tests/test_ring.py", "netns_tests/test_ring_live.py"
_PACED: Final = (
    f"{_RING}::test_a_recording_crosses_at_an_even_pace_and_an_eavesdropper_learns_no_topic_no_type_and_no_content"
)
_RUN_BY: Final = {  # what another test runs already, with the same options or stricter ones
    "scripts/ring_topology.sh --seconds 5": _PACED,
    "scripts/ring_topology.sh --live --seconds 5": f"{_LIVE}::test_what_real_nodes_say_is_heard_at_the_other_end",
    "scripts/ring_topology.sh --live mixed --seconds 5": f"{_LIVE}::test_what_real_nodes_say_is_heard_at_the_other_end",
    "scripts/ring_topology.sh --seconds 5 --pcap eavesdropped.pcap": _PACED,
    "scripts/ring_topology.sh --seconds 8 --roam robot:nuc3@4": (
        f"{_RING}::test_what_fails_and_moves_one_after_the_other_costs_no_message"
    ),
    "scripts/internet_demo.sh --figure1": (
        "netns_tests/test_internet_demo.py"
        "::test_figure_1_a_ros_2_drone_changes_networks_and_no_image_and_no_command_of_a_ros_1_cloud_is_lost"
    ),
    "fog launch examples/listing1.launch.py": (
        "netns_tests/test_fog.py"
        "::test_the_listing_of_the_paper_plans_grasps_on_two_machines_and_the_robot_finds_each_right"
    ),
    "python scripts/experiments/offload.py --quick": (
        "netns_tests/test_experiments.py"
        "::test_a_task_is_computed_on_the_robot_and_beyond_three_domains_in_either_encoding_and_every_answer_is_right"
    ),
}
_MINUTE_S: Final = 60
_COMMANDS: Final = {command: seconds for claim in CLAIMS for command, seconds in claim.commands}
_SHORT: Final = {command for command, seconds in _COMMANDS.items() if seconds is not None and seconds < _MINUTE_S}


def _is_run(claim: Claim) -> bool:
    return any(command in _SHORT - _RUN_BY.keys() for command, _ in claim.commands)


@pytest.mark.parametrize("claim", [claim for claim in CLAIMS if _is_run(claim)], ids=lambda claim: claim.title[:60])
def test_a_command_of_under_a_minute_prints_what_the_page_says(claim: Claim, tmp_path: Path) -> None:
    for name in ("scripts", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    environment = {**os.environ, "PATH": path, "FOG_STATE": str(tmp_path / "state"), "COLUMNS": "200"}
    environment.pop("GDP_SALT", None)
    printed = ""
    for command, _ in claim.commands:
        if command.startswith("python scripts/experiments/"):
            pytest.importorskip("matplotlib", reason="needs the extra experiments")
        program, *words = shlex.split(command)
        argv = [shutil.which(program, path=path) or program, *words]
        done = subprocess.run(argv, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{command}: {done.stderr}"
        printed += done.stdout
    for text in claim.shown:
        assert " ".join(text.split()) in " ".join(printed.split())


@pytest.mark.parametrize(("command", "test"), _RUN_BY.items(), ids=_RUN_BY)
def test_a_command_that_another_test_runs_is_on_the_page_and_that_test_exists(command: str, test: str) -> None:
    assert command in _SHORT
    _assert_test(test, may_be_nightly=command.startswith("python scripts/experiments/"))


@pytest.mark.parametrize("command", sorted(each for each in _COMMANDS if each.startswith("pytest ")))
def test_a_test_that_the_page_names_exists(command: str) -> None:
    _assert_test(command.removeprefix("pytest "))


@pytest.mark.parametrize("command", sorted(each for each in _COMMANDS if each.startswith("python ")))
def test_a_script_that_the_page_names_has_the_options_of_its_command(command: str) -> None:
    script, *words = shlex.split(command)[1:]
    sources = (ROOT / script).read_text() + (ROOT / "scripts/experiments/experiment.py").read_text()
    for option in (word for word in words if word.startswith("--")):
        assert f'"{option}"' in sources


def test_each_claim_has_a_command_with_its_time_or_says_that_there_is_none() -> None:
    for claim in CLAIMS:
        assert len(claim.cells) == 4, claim.title
        assert all(claim.cells), claim.title
        assert claim.commands or claim.cells[1] == "none", claim.title
        for command, seconds in claim.commands:
            assert (seconds is None) == command.startswith("pytest "), command


def test_every_figure_table_and_listing_of_both_papers_has_a_row() -> None:
    titles = [claim.title.partition(":")[0] for claim in CLAIMS]
    figures = [title for title in titles if title.startswith(("Figure", "Table", "Listing"))]
    first = ["Figure 1", "Figures 2 to 4", "Table I", "Figure 5"]
    second = ["Figures 1 to 3", "Listing 1", "Figure 4", "Table I", *(f"Figure {number}" for number in range(5, 10))]
    assert figures == first + second


def test_the_first_screen_of_the_readme_leads_to_the_page() -> None:
    first = (ROOT / "README.md").read_text().split("\n## ")[0]
    assert "](docs/papers.md)" in first


def _assert_test(named: str, *, may_be_nightly: bool = False) -> None:
    path, _, function = named.partition("::")
    tree = ast.parse((ROOT / path).read_text())
    found = {node.name: node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}
    tests = [found[function]] if function else [each for name, each in found.items() if name.startswith("test_")]
    assert any(
        may_be_nightly or "pytest.mark.nightly" not in map(ast.unparse, each.decorator_list) for each in tests
    ), "nothing of it is in the change lane"
