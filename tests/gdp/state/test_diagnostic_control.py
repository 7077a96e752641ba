"""Diagnostic requests and tables over the control socket, between two nodes of an in-memory network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from gdp.control.diagnostics import Question
from gdp.errors import LocalError
from gdp.management.control_client import NodeConnection
from gdp.management.control_socket import CONTROL_SOCKET, ControlHandlers, serve_control_in_thread
from gdp.sansio import Timestamps
from gdp.state.control_protocol import Respond, Response
from gdp.state.diagnostic_control import DiagnosticCommands, as_json
from lab.simulation import Simulation
from lab.topology import Attachment, DomainPlan, Link, Topology
from tests.gdp.state.memory_states import switch_state

ROWS = [{"number": number, "name": bytes([number % 256]) * 32, "none": None} for number in range(450)]


@pytest.fixture(scope="module")
def world() -> Simulation:
    topology = Topology(
        (Link("one", "two"),),
        (DomainPlan("lab", ("one", "two")),),
        (Attachment("one", "rib", "rib"), Attachment("two", "proxy", "robot")),
    )
    made = Simulation(topology=topology)
    assert made.run_until_attached()
    return made


def commands(world: Simulation) -> DiagnosticCommands:
    """Return the handlers of the switch ``one``."""
    return DiagnosticCommands(
        state=switch_state(world, "one"), now=lambda: world.network.now, tables={"rows": lambda _now: ROWS}
    )


def asked(world: Simulation, arguments: Mapping[str, object]) -> Response:
    """Return the response to an ``ask``."""
    got: list[Response] = []
    commands(world).ask(arguments, got.append)
    world.network.send_pending("one")
    assert world.network.run(2, lambda: bool(got))
    return got[0]


def test_a_reply_of_another_member_comes_back_as_json(world: Simulation) -> None:
    target = world.members["two/robot"].name.to_text()
    result = asked(world, {"id": 7, "ask": "ping", "target": target, "name": target}).result
    assert (result["id"], result["state"], result["node"]) == (7, "answered", target)
    assert (result["role"], result["domain_label"], result["result"]) == ("proxy", "lab", {"rights": []})
    assert (result["switches"], result["withheld"], result["cut"], result["error"]) == (1, False, False, "")


def test_without_a_reply_the_response_says_so(world: Simulation) -> None:
    result = asked(world, {"id": "x", "ask": "ping", "target": "ab" * 32, "timeout_s": 0.3}).result
    assert (result["id"], result["state"]) == ("x", "silent")
    assert isinstance(result["rtt_ms"], float)
    assert result["rtt_ms"] >= 300


def test_names_in_a_body_arrive_as_bytes(world: Simulation) -> None:
    seen: list[object] = []

    def answer(question: Question, _now: Timestamps) -> Mapping[str, object]:
        seen.append(dict(question.body))
        return {}

    world.switches["two"].diagnostics.register("note", answer)
    target = world.switches["two"].name.to_text()
    asked(world, {"id": 1, "ask": "note", "target": target, "body": {"p": "ab" * 32, "word": "x"}})
    assert seen == [{"p": b"\xab" * 32, "word": "x"}]


def test_without_a_target_the_own_switch_answers(world: Simulation) -> None:
    assert asked(world, {"id": 1, "ask": "ping"}).result["node"] == world.switches["one"].name.to_text()


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"ask": 1},
        {"ask": "ping", "target": "ab"},
        {"ask": "ping", "target": 7},
        {"ask": "ping", "hops": 0},
        {"ask": "ping", "timeout_s": True},
        {"ask": "ping", "reply_bytes": 9_000},
        {"ask": "ping", "body": []},
        {"ask": "a word that is too long", "target": "ab" * 32},
    ],
)
def test_a_wrong_argument_is_refused_with_its_reason(world: Simulation, arguments: Mapping[str, object]) -> None:
    with pytest.raises(LocalError):
        commands(world).ask(arguments, lambda _response: None)


def test_a_table_comes_in_pages_and_none_is_lost(world: Simulation) -> None:
    first = commands(world).show({"what": "rows"})
    assert first["next"] == 200
    last = commands(world).show({"what": "rows", "from": 400})
    assert (len(list(last["rows"])), last["next"]) == (50, None)  # type: ignore[call-overload]


def test_a_table_that_the_node_does_not_keep_is_refused_with_those_that_it_keeps(world: Simulation) -> None:
    with pytest.raises(LocalError, match="a switch keeps no table 'trees'; it keeps rows"):
        commands(world).show({"what": "trees"})


def test_bytes_become_hex_digits_at_every_depth() -> None:
    assert as_json({"a": [b"\x01", {"b": b"\x02"}], "c": None}) == {"a": ["01", {"b": "02"}], "c": None}


class Later:
    """Handlers that respond to the second request first."""

    def __init__(self) -> None:
        self._first: tuple[object, Respond] | None = None

    def ask(self, arguments: Mapping[str, object], respond: Respond) -> None:
        if arguments["ask"] == "fail":
            raise LocalError("no switch")
        if self._first is None:
            self._first = arguments["id"], respond
        else:
            respond(Response({"id": arguments["id"], "state": "answered"}))
            self._first[1](Response({"id": self._first[0], "state": "silent"}))


@pytest.fixture
def socket(tmp_path: Path, world: Simulation) -> Iterator[Path]:
    later, path = Later(), tmp_path / CONTROL_SOCKET
    handlers = ControlHandlers(
        reload=lambda: None, status=dict, drain=lambda: None, ask=later.ask, show=commands(world).show
    )
    with serve_control_in_thread(path, handlers):
        yield path


def test_responses_that_overtake_each_other_are_matched_by_id(socket: Path) -> None:
    with NodeConnection(socket) as connection:
        first, second = connection.ask_all([("one", {}), ("two", {})])
    assert (first["state"], second["state"]) == ("silent", "answered")


def test_a_refused_request_raises_with_the_reason(socket: Path) -> None:
    with NodeConnection(socket) as connection, pytest.raises(LocalError, match="no switch"):
        connection.ask("fail")


def test_a_client_gets_all_pages_of_a_table(socket: Path) -> None:
    with NodeConnection(socket) as connection:
        rows = connection.show("rows")
    assert [row["number"] for row in rows] == list(range(450))
    assert rows[3]["name"] == "03" * 32


def test_a_node_that_keeps_no_tables_says_so(tmp_path: Path) -> None:
    handlers = ControlHandlers(reload=lambda: None, status=dict, drain=lambda: None)
    path = tmp_path / CONTROL_SOCKET
    with (
        serve_control_in_thread(path, handlers),
        NodeConnection(path) as connection,
        pytest.raises(LocalError, match="no tables"),
    ):
        connection.show("names")
