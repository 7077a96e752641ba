"""Options of the ring."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdp.errors import LocalError
from ring.cli import spelled_out
from ring.faults import fault_from_text
from ring.options import Options


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
        {"faults": (fault_from_text("cut", "nuc1-nuc3@1"),)},
        {"live": "ros2", "faults": (fault_from_text("cut", "nuc1-nuc2@10"),)},
        {"faults": (fault_from_text("kill", "switch:nuc1@1"),)},
        {"faults": (fault_from_text("roam", "cat:nuc2@1"),)},
        {"seconds": 4.0, "rate": 2.0},
        {"seconds": 0.5},
        {"lease_s": 0.5},
        {"live": "ros2", "seconds": 0.5},
        {"live": "ros2", "seconds": float("nan")},
        {"live": "ros2", "rate": 0.0},
        {"live": "ros1", "bag": Path(__file__)},
        {"live": "mixed", "out": Path("/tmp")},
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_starts(options: dict[str, object]) -> None:
    with pytest.raises(LocalError):
        Options(**options)  # type: ignore[arg-type]


def test_settings_are_what_json_can_write() -> None:
    faults = (
        fault_from_text("cut", "nuc2-nuc3@5"),
        fault_from_text("roam", "robot:nuc2@6"),
        fault_from_text("kill", "rib:school@7-9"),
    )
    assert Options(faults=faults).settings() == {
        "recording": "demo",
        "rate": 1.0,
        "seconds": None,
        "encoding": "json",
        "data_plane": "auto",
        "cores": False,
        "mtu": 1_500,
        "lease_s": 24.0,
        "cuts": ["nuc2-nuc3@5"],
        "roams": ["robot:nuc2@6"],
        "kills": ["rib:school@7-9"],
    }


def test_a_live_run_has_no_recording_in_its_settings() -> None:
    settings = Options(live="mixed").settings()
    assert settings["live"] == "mixed"
    assert settings["seconds"] == 10
    assert not {"recording", "rate"} & settings.keys()


@pytest.mark.parametrize(
    ("words", "spelled"),
    [
        (["--live"], ["--live", "ros2"]),
        (["--live", "ros1"], ["--live", "ros1"]),
        (["--live", "--keep"], ["--live", "ros2", "--keep"]),
        (["--live=mixed", "--keep"], ["--live=mixed", "--keep"]),
        ([], []),
    ],
)
def test_live_alone_means_ros_2(words: list[str], spelled: list[str]) -> None:
    assert list(spelled_out(words)) == spelled
