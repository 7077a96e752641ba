"""Lines that the demonstration of an internet prints while it runs without a terminal."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
from rich.console import Console

from internet.overlay import Link
from internet_demo import scenario as display


def test_a_line_of_progress_of_the_usual_counts_fits_100_columns(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(display, "_PLAIN_EVERY_S", 0.0)
    calls = SimpleNamespace(answered=987, begun=988)
    traffic = SimpleNamespace(
        counts={"cloud-a": 988, "edge": 988}, images=SimpleNamespace(sent_s=range(988)), calls=calls
    )
    ways = (("cloud-b", False), ("cloud-b", False), ("cloud-a", True), ("edge", True))
    tunnels = [Link(peer, "wlan0", is_direct, "198.51.100.2:51820") for peer, is_direct in ways]
    display.Display(Console(width=160)).show((), {"robot": tunnels}, cast(Any, traffic))
    line = capsys.readouterr().out.rstrip()
    assert line.endswith("987 of 988 calls; direct cloud-a, edge; border cloud-b")
    assert len(line) <= 100
