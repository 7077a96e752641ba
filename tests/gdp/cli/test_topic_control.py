"""``gdp control``: what it asks of the readers of a topic, and what it prints."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from gdp.cli.gdp import main
from gdp.management import running_nodes
from gdp.management.control_socket import ControlHandlers, serve_control_in_thread
from gdp.state.control_protocol import Respond, Response

DRIVE, DESK, ROBOT, OTHER = "0b" * 32, "0c" * 32, "aa" * 32, "bb" * 32


class Desk:
    """A node that publishes a topic, which two robots read: one under exclusive control."""

    def __init__(self) -> None:
        self.asked: list[Mapping[str, object]] = []
        self.error = ""
        self.readers: tuple[str, ...] = (ROBOT, OTHER)
        self.is_silent = False

    def handlers(self) -> ControlHandlers:
        return ControlHandlers(
            reload=lambda: None,
            status=lambda: {"role": "proxy", "label": "desk", "name": DESK},
            drain=lambda: None,
            ask=self._ask,
            show=self._show,
        )

    def _show(self, arguments: Mapping[str, object]) -> Mapping[str, object]:
        names: list[dict[str, object]] = [{"local": "/cmd_vel", "name": DRIVE}]
        peers: list[dict[str, object]] = [{"peer": each, "is": "reader", "name": DRIVE} for each in self.readers]
        return {"rows": names if arguments["what"] == "names" else peers, "next": None}

    def _ask(self, arguments: Mapping[str, object], respond: Respond) -> None:
        body, target = arguments.get("body"), arguments.get("target")
        assert isinstance(body, dict)
        fields: dict[str, object] = {"id": arguments["id"], "label": "robot", "result": {}, "error": ""}
        if target == ROBOT:
            self.asked.append(body)
            shown = {"state": "held", "holder": "desk", "refused": 3, "generation": 7, "error": ""}
            fields["result"] = {**shown, "error": self.error} if body else shown
        is_silent = self.is_silent and body
        respond(Response({**fields, "result": {}, "state": "silent"} if is_silent else {**fields, "state": "answered"}))


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    monkeypatch.setattr(running_nodes, "control_sockets", lambda: sorted(tmp_path.glob("*.sock")))
    made = Desk()
    with serve_control_in_thread(tmp_path / "desk.sock", made.handlers()):
        yield made


def control(*words: str) -> int:
    """Run the command; return its exit code."""
    try:
        main(("control", *words))
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


@pytest.mark.usefixtures("desk")
def test_show_prints_a_row_for_each_reader_under_control(capsys: pytest.CaptureFixture[str]) -> None:
    assert control("show", "/cmd_vel") == 0
    head, row = capsys.readouterr().out.splitlines()
    assert (head.split(), row.split()) == (["at", "state", "holder", "refused"], ["robot", "held", "desk", "3"])


def test_take_states_what_it_has_seen_and_when_it_was_asked(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    assert control("take", "/cmd_vel", "--force", "--json") == 0
    first, taken = desk.asked
    assert first == {}
    assert {key: value for key, value in taken.items() if key != "at"} == {"do": "take", "seen": 7, "force": True}
    assert isinstance(taken["at"], int)
    assert [each["at"] for each in json.loads(capsys.readouterr().out)["readers"]] == ["robot"]


def test_give_names_another_publisher_or_none(desk: Desk) -> None:
    assert control("give", "/cmd_vel", "desk2") == 0
    assert control("give", "/cmd_vel") == 0
    assert [body["to"] for body in desk.asked if body] == ["desk2", ""]


@pytest.mark.parametrize(("error", "is_silent"), [("another publisher holds control", False), ("", True)])
def test_a_refusal_and_silence_end_with_1(
    desk: Desk, capsys: pytest.CaptureFixture[str], error: str, is_silent: bool
) -> None:
    desk.error, desk.is_silent = error, is_silent
    assert control("take", "/cmd_vel") == 1
    assert f"error: robot: {error or 'no answer: it may have been done'}" in capsys.readouterr().err


def test_a_topic_without_a_reader_under_control_is_named(desk: Desk, capsys: pytest.CaptureFixture[str]) -> None:
    desk.readers = (OTHER,)
    assert control("show", "/cmd_vel") == 2
    assert "control: exclusive" in capsys.readouterr().err
