"""Faults, as a person writes them: parsed, compared with the topology, and refused if no delivery were possible."""

from __future__ import annotations

import pytest

from gdp.errors import LocalError
from lab.faults import Fault, FaultKind
from lab.topology import ring5
from ring.faults import check_faults, fault_from_text, roamers, text_of


def fault(text: str) -> Fault:
    if text.startswith(("rib:", "switch:")):
        return fault_from_text("kill", text)
    return fault_from_text("roam", text) if ":" in text else fault_from_text("cut", text)


def check(*texts: str, duration_s: float | None = None) -> None:
    check_faults(ring5(), [fault(text) for text in texts], duration_s)


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("nuc2-nuc3@5", Fault(FaultKind.CUT, ("nuc2", "nuc3"), 5.0)),
        ("nuc3-nuc2@0.5", Fault(FaultKind.CUT, ("nuc3", "nuc2"), 0.5)),
        ("nuc4-nuc5@5-20", Fault(FaultKind.CUT, ("nuc4", "nuc5"), 5.0, 20.0)),
        ("rib:school@8", Fault(FaultKind.KILL_RIB, ("rib school",), 8.0)),
        ("switch:nuc3@10-20.5", Fault(FaultKind.KILL_SWITCH, ("switch nuc3",), 10.0, 20.5)),
        ("robot:nuc3@10", Fault(FaultKind.ROAM, ("robot", "nuc3"), 10.0, 10.0)),
    ],
)
def test_a_fault_reads_as_it_is_written(text: str, read: Fault) -> None:
    assert (fault(text), text_of(read)) == (read, text)


@pytest.mark.parametrize("text", ["", "nuc2", "nuc2-nuc3", "nuc2@5", "nuc2-nuc3@", "nuc2-nuc3@-1", "nuc2-nuc3@soon"])
def test_a_cut_written_otherwise_is_refused(text: str) -> None:
    with pytest.raises(LocalError, match="a cut is written like nuc2-nuc3@5"):
        fault_from_text("cut", text)


@pytest.mark.parametrize("text", ["", "nuc3@5", "proxy:nuc3@5", "rib:@5", "switch:nuc3", "switch:nuc3@-5"])
def test_a_kill_written_otherwise_is_refused(text: str) -> None:
    with pytest.raises(LocalError, match="a kill is written like rib:school@8"):
        fault_from_text("kill", text)


@pytest.mark.parametrize("text", ["", "robot@5", "robot:nuc3", "robot:nuc3@5-9"])
def test_roaming_written_otherwise_is_refused(text: str) -> None:
    with pytest.raises(LocalError, match="roaming is written like robot:nuc3@10"):
        fault_from_text("roam", text)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("nuc1-nuc3@5", "no link nuc1-nuc3; there are nuc1-nuc2"),
        ("rib:garden@5", "no RIB garden; there are those of school, backbone, cloud"),
        ("rib:nuc1@5", "no RIB nuc1"),
        ("switch:nuc9@5", "no switch nuc9; there are nuc1"),
        ("cat:nuc3@5", "no proxy cat; there are robot, server"),
        ("robot:nuc9@5", "no switch nuc9"),
        ("robot:nuc1@5", "robot is at nuc1 already"),
        (
            "switch:nuc1@5",
            r"with switch nuc1 dead, robot has no switch: let it roam before, or .* \(switch:nuc1@10-20\)",
        ),
        ("switch:nuc5@5", "with switch nuc5 dead, server has no switch"),
    ],
)
def test_what_is_not_there_or_parts_an_end_is_refused(text: str, complaint: str) -> None:
    with pytest.raises(LocalError, match=complaint):
        check(text)


@pytest.mark.parametrize("text", ["nuc4-nuc5@5-5", "switch:nuc3@9-5"])
def test_what_comes_back_before_it_goes_is_refused(text: str) -> None:
    with pytest.raises(LocalError, match="it comes back before it goes"):
        check(text)


def test_two_cuts_that_leave_no_way_are_refused_unless_one_heals() -> None:
    with pytest.raises(LocalError, match="after nuc4-nuc5@9 no way is left from robot at nuc1 to server at nuc5"):
        check("nuc1-nuc5@5", "nuc4-nuc5@9")
    check("nuc1-nuc5@5-20", "nuc4-nuc5@9")


def test_a_cut_and_a_dead_switch_part_the_ends_as_two_cuts_do() -> None:
    with pytest.raises(LocalError, match="no way is left"):
        check("switch:nuc3@5", "nuc1-nuc5@9")


def test_a_switch_may_die_once_its_proxy_has_left_it() -> None:
    check("robot:nuc2@5", "switch:nuc1@10")
    with pytest.raises(LocalError, match="robot has no switch"):
        check("robot:nuc2@10", "robot:nuc1@15", "switch:nuc1@20")


def test_one_thing_fails_once_at_a_time() -> None:
    with pytest.raises(LocalError, match="nuc3-nuc2@9 comes before nuc2-nuc3@5-20 is over"):
        check("nuc2-nuc3@5-20", "nuc3-nuc2@9")
    check("nuc2-nuc3@5-8", "nuc3-nuc2@9", "rib:school@9", "rib:cloud@9")


@pytest.mark.parametrize("text", ["nuc2-nuc3@10", "nuc2-nuc3@5-10", "robot:nuc3@12"])
def test_what_comes_after_the_traffic_is_refused(text: str) -> None:
    with pytest.raises(LocalError, match=r"comes too late: the traffic lasts 10 s \(--seconds\)"):
        check(text, duration_s=10.0)
    check(text, duration_s=12.5)


def test_each_proxy_that_roams_is_named_once() -> None:
    moves = [fault("robot:nuc2@1"), fault("robot:nuc3@2"), fault("nuc1-nuc2@3")]
    assert list(roamers(moves, ring5())) == ["robot"]
