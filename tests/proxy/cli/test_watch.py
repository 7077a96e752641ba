"""``gdp watch``: events of a name, from the status of the running proxy."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from gdp.management.control_socket import ControlHandlers, serve_control_in_thread
from proxy.bridge.liveliness import NameLiveliness, Party
from tests.gdp.sharing.machines import Site

Run = Callable[..., "tuple[int, str, str]"]
ONE, TWO = "11" * 32, "22" * 32


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = Site(tmp_path).add("robot").folder
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def run(*words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as leaving:
            main(["watch", *words])
        shown = capsys.readouterr()
        return int(leaving.value.code or 0), shown.out, shown.err

    return run


def serve(folder: Path, *observed: list[Party]) -> Iterator[None]:
    """Run a proxy that shows one observation after the other, and the last one from then on."""
    left = list(observed)

    def status() -> dict[str, object]:
        parties = left.pop(0) if left[1:] else left[0]
        name = NameLiveliness("topic", "/scan", "/robot1/scan", True, True, parties)
        return {"names": 1, "liveliness": [name.to_fields()]}

    def nothing() -> None:
        pass

    with serve_control_in_thread(
        folder / "control.sock", ControlHandlers(reload=nothing, status=status, drain=nothing)
    ):
        yield


def test_events_are_lines_of_json(robot: Path, run: Run) -> None:
    first, second = Party("reader", ONE), Party("reader", TWO, is_silent=True)
    for _ in serve(robot, [first], [first, second], [second]):
        code, shown, _ = run("/robot1/*", "--json", "--count", "4")
        events = [json.loads(line) for line in shown.splitlines()]
        assert code == 0
        assert [(each["event"], each["node"]) for each in events] == [
            ("appears", ONE), ("appears", TWO), ("silent", TWO), ("goes", ONE),
        ]  # fmt: skip
        assert {each["name"] for each in events} == {"/robot1/scan"}


def test_events_are_lines_for_people(robot: Path, run: Run) -> None:
    for _ in serve(robot, [Party("reader", ONE)]):
        assert run("/scan", "--for", "0")[1].endswith("  /robot1/scan  reader 111111111111 appears\n")


def test_a_name_that_the_proxy_does_not_carry_is_reported(robot: Path, run: Run) -> None:
    for _ in serve(robot, [Party("reader", ONE)]):
        code, shown, error = run("/other", "--for", "0")
        assert (code, shown) == (0, "")
        assert "/other: this proxy carries no such name yet" in error


def test_without_a_proxy_the_exit_code_is_three(robot: Path, run: Run) -> None:
    code, _, error = run("/scan")
    assert code == 3
    assert "no process serves this control socket" in error


def test_a_wrong_name_is_refused(robot: Path, run: Run) -> None:
    assert run("scan")[0] == 2
