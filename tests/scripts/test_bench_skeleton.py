"""Skeleton of the benches: records, exit status, processes that take commands."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from machine import machine_state
from report import Rounds, markdown_table, write_json
from skeleton import Outcome, command_line, finish, parse

from gdp.host.run_registry import RunRegistry
from lab.process import Event, FailedError, LabProcess, until
from lab.topology import Link, ends_of, flat_topology, make_topology, single

COMMAND = "import sys; sys.path.insert(0, {!r}); from peers.jsonl import read_order, say; {}"
BENCH = str(Path(__file__).resolve().parents[2] / "scripts" / "bench")


def over(who: str, value: float) -> Rounds:
    found = Rounds()
    found.add(who, "case", "s", value)
    return found


def outcome(value: float) -> Outcome:
    rounds = over("flow", value)
    target = rounds.target("silence, s", "flow", "case", "s", 1.0, at_most=True)
    return Outcome("survive", "Survive", rounds, [target], {})


def test_rows_of_an_earlier_record_stay_where_the_bench_keeps_them(tmp_path: Path) -> None:
    path, state = tmp_path / "figures.json", machine_state()
    first, second = over("cut", 1.0), over("roam", 2.0)
    write_json(path, "survive", state, {}, first, [first.target("cut", "cut", "case", "s", 1.0)], keeps=True)
    write_json(path, "survive", state, {}, second, [second.target("roam", "roam", "case", "s", 1.0)], keeps=True)
    document = json.loads(path.read_text())
    assert list(document["rounds"]) == ["cut", "roam"]
    assert [target["what"] for target in document["targets"]] == ["cut", "roam"]


def test_a_row_that_was_measured_again_replaces_the_earlier_one(tmp_path: Path) -> None:
    path, state = tmp_path / "figures.json", machine_state()
    for value in (1.0, 2.0):
        write_json(path, "survive", state, {}, over("cut", value), keeps=True)
    assert json.loads(path.read_text())["rounds"] == {"cut": {"case": {"s": [2.0]}}}


def test_a_missed_target_is_no_failure_and_a_failed_outcome_is_one() -> None:
    options, missed = parse(command_line("", has_record=True), []), outcome(2.0)
    finish(missed, options, machine_state(), 0.0, is_saved=False, is_drawn=False)
    with pytest.raises(SystemExit, match="1"):
        finish(replace(missed, has_failed=True), options, machine_state(), 0.0, is_saved=False, is_drawn=False)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[[str], LabProcess]]:
    """Yield a function that starts a process with this program, which takes commands."""
    run = RunRegistry(tmp_path / "runs").start()

    def started(program: str) -> LabProcess:
        argv = [sys.executable, "-c", COMMAND.format(BENCH, program)]
        return LabProcess(run, "end", argv, has_orders=True)

    yield started
    run.end()


def test_a_process_answers_commands_and_ends_when_there_are_no_more(start: Callable[[str], LabProcess]) -> None:
    with start("\nwhile True: say(twice=2 * read_order()['number'])") as end:
        assert end.ask(number=4) == {"twice": 8}
        assert end.ask(number=5) == {"twice": 10}
    assert end.code == 0


def test_a_process_that_refuses_is_an_error_with_its_reason(start: Callable[[str], LabProcess]) -> None:
    with start("say(refused_because='no CAP_BPF')") as end, pytest.raises(FailedError, match="no CAP_BPF"):
        end.read(20.0)


@pytest.mark.parametrize("line", ["", "x", "[]", "1"])
def test_a_line_that_is_no_object_is_an_error(start: Callable[[str], LabProcess], line: str) -> None:
    with start(f"print({line!r}, flush=True)") as end, pytest.raises(FailedError, match="said"):
        end.read(20.0)


def test_a_process_that_goes_on_is_an_error_to_one_that_reaps_it(start: Callable[[str], LabProcess]) -> None:
    with start("read_order()") as end, pytest.raises(FailedError, match="still runs"):
        end.reap(0.01)


def test_events_are_taken_without_waiting(start: Callable[[str], LabProcess]) -> None:
    found = list[Event]()
    with start("say(event='ready'); say(event='done')") as end:
        until(lambda: end.is_silent, meanwhile=lambda: found.extend(end.take_events()))
    assert [each["event"] for each in found] == ["ready", "done"]


def test_a_table_in_markdown_aligns_its_last_columns_to_the_right() -> None:
    assert markdown_table(("who", "s"), [("we", "1")], numbers=1) == "| who | s |\n| --- | --: |\n| we | 1 |"


def test_members_of_a_topology_hang_at_their_home_and_belong_to_its_domain() -> None:
    topology, members = make_topology({"a": ("s1", "s2")}, {}, ("s1-s2",), ("s1",), {"P": "s2"})
    assert members == ("P",)
    assert topology.domain_of("P").label == "a"
    assert Link("P", "s2") in topology.links


def test_a_flat_topology_is_one_domain_in_the_stated_order() -> None:
    links: Sequence[tuple[str, str]] = [ends_of("b-s1"), ends_of("s1-a")]
    topology = flat_topology(links, mtu=1_500, rib="s1", members=("a", "b"), switches=("a", "s1", "b"))
    assert topology.nodes == ("a", "s1", "b")
    assert len(topology.domains) == 1
    assert single("robot").nodes == ("robot",)
