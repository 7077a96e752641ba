"""What may be asked of the ring."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.errors import LocalError
from proxy.ring.options import Cut, Options


def test_a_cut_names_link_and_second() -> None:
    assert Cut.from_text("nuc2-nuc3@5") == Cut("nuc2", "nuc3", 5.0)
    assert Cut.from_text("nuc3-nuc2@0.5") == Cut("nuc3", "nuc2", 0.5)
    assert str(Cut("nuc2", "nuc3", 5.0)) == "nuc2-nuc3@5"


@pytest.mark.parametrize("text", ["", "nuc2", "nuc2-nuc3", "nuc2@5", "nuc2-nuc3@", "nuc2-nuc3@-1", "nuc2-nuc3@soon"])
def test_a_cut_written_otherwise_is_refused(text: str) -> None:
    with pytest.raises(LocalError, match="a cut is written like nuc2-nuc3@5"):
        Cut.from_text(text)


@pytest.mark.parametrize(
    "options",
    [
        {"rate": -1.0},
        {"rate": float("inf")},
        {"rate": float("nan")},
        {"mtu": 100},
        {"mtu": 65_522},
        {"bag": Path("/nowhere/my.bag")},
        {"json": Path("/nowhere/result.json")},
        {"pcap": Path("/nowhere/seen.pcap")},
        {"cuts": (Cut("nuc1", "nuc3", 1.0),)},
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_starts(options: dict[str, object]) -> None:
    with pytest.raises(LocalError):
        Options(**options)  # type: ignore[arg-type]


def test_settings_are_what_json_can_write() -> None:
    assert Options(cuts=(Cut("nuc2", "nuc3", 5.0),)).settings() == {
        "recording": "demo",
        "rate": 1.0,
        "encoding": "json",
        "data_plane": "auto",
        "mtu": 1_500,
        "cuts": ["nuc2-nuc3@5"],
    }
