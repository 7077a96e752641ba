"""Text of others on a terminal, which would obey its control characters."""

from __future__ import annotations

import io
import json
import unicodedata

import pytest
import typer
import yaml
from hypothesis import given
from hypothesis import strategies as st

from gdp.cli.node import emit, failing_clearly
from gdp.cli.output import show
from gdp.errors import LocalError
from gdp.printable import escaped, printable
from gdp.terminal import echo
from proxy.cli.tool_options import print_json, print_text
from proxy.serial.standard_types import known_channel
from proxy.tools.message_text import MessageText, request_of

HOSTILE = "a\x1b]0;title\x07\x9b2J\x7f\u202eb\u2066\u200b\U000e0041\ue000\r\x08é日本"
CONTROLS = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
STRING = known_channel("/a", "std_msgs/msg/String")


class Stream(io.TextIOWrapper):
    """Standard output, or its stand-in, that is a terminal or not."""

    def __init__(self, is_terminal: bool) -> None:
        super().__init__(io.BytesIO(), encoding="utf-8", newline="")
        self.is_terminal = is_terminal

    def isatty(self) -> bool:
        return self.is_terminal

    @property
    def text(self) -> str:
        self.flush()
        raw = self.buffer
        assert isinstance(raw, io.BytesIO)
        return raw.getvalue().decode()


def open_terminal(monkeypatch: pytest.MonkeyPatch) -> Stream:
    """Return a terminal that is standard output and standard error."""
    stream = Stream(is_terminal=True)
    monkeypatch.setattr("sys.stdout", stream)
    monkeypatch.setattr("sys.stderr", stream)
    return stream


def hidden_in(text: str) -> list[str]:
    return [each for each in text if each not in "\n\t" and unicodedata.category(each) in CONTROLS]


def test_z04_a_message_in_yaml_shows_no_character_that_a_terminal_obeys(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch)
    print_text(MessageText(STRING).to_yaml(request_of(STRING, {"data": HOSTILE})))
    assert hidden_in(terminal.text) == []
    assert "é日本" in terminal.text


def test_z04_a_message_in_json_shows_none_and_stays_the_same_json(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch)
    print_json({"message": MessageText(STRING).to_json(request_of(STRING, {"data": HOSTILE}))})
    assert hidden_in(terminal.text) == []
    assert json.loads(terminal.text) == {"message": {"data": HOSTILE}}


def test_z04_results_events_and_errors_show_none(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch)
    show({"name": HOSTILE}, as_json=True)
    show({"name": HOSTILE}, as_json=False)
    show({}, as_json=False, plain=HOSTILE)
    emit("ready", name=HOSTILE)
    echo(HOSTILE, err=True)
    with pytest.raises(typer.Exit), failing_clearly():
        raise LocalError(HOSTILE)
    assert len(terminal.text.splitlines()) == 6
    assert hidden_in(terminal.text) == []


@pytest.mark.parametrize("write", [print_text, echo])
def test_z04_files_and_pipes_get_the_text_as_it_is(write: object, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Stream(is_terminal=False)
    monkeypatch.setattr("sys.stdout", stream)
    assert callable(write)
    write(HOSTILE)
    assert stream.text == HOSTILE + "\n"


@given(st.text())
def test_z04_no_text_escapes_the_escaping(text: str) -> None:
    assert hidden_in(escaped(text)) == hidden_in(printable(text)) == []
    assert json.loads(escaped(json.dumps({"a": text}, ensure_ascii=False))) == {"a": text}


def test_z04_a_terminal_gets_yaml_that_names_the_escaped_characters() -> None:
    shown = escaped(yaml.safe_dump({"data": "a\u202eb"}, allow_unicode=True))
    assert shown == "data: a\\u202eb\n"
