"""``gdp ping``, ``gdp trace`` and ``gdp show``: their output, and how they find nodes and names."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from gdp.cli import tables
from gdp.cli.gdp import main
from gdp.cli.local_nodes import local_nodes
from gdp.cli.ping import PingStatistics, quantile
from gdp.cli.trace import path_lines
from gdp.management import running_nodes
from gdp.management.control_socket import ControlHandlers, serve_control_in_thread
from gdp.state.control_protocol import Respond, Response

SCAN, OTHER, ROBOT = "0b" * 32, "0c" * 32, "aa" * 32
LONG = "x" * 300


class Node:
    """A node that answers as a proxy whose publisher is the robot."""

    def __init__(self, label: str, role: str = "proxy") -> None:
        self.label = label
        self.role = role
        self.places: list[dict[str, str]] = [{"node": ROBOT, "right": "publish"}, {"node": OTHER, "right": "read"}]
        self.is_silent = False
        self.is_ping_lost = False
        self.asked: list[Mapping[str, object]] = []
        self.target_role = "proxy"
        self.pid = 0

    def handlers(self) -> ControlHandlers:
        return ControlHandlers(
            reload=lambda: None,
            status=lambda: {"role": self.role, "label": self.label, "name": OTHER, "pid": self.pid},
            drain=lambda: None,
            ask=self._ask,
            show=self._show,
        )

    def _show(self, arguments: Mapping[str, object]) -> Mapping[str, object]:
        rows: list[dict[str, object]] = [{"local": "/scan", "name": SCAN, "note": LONG}]
        rows += [{"local": "/twice", "name": digit * 64, "note": ""} for digit in "12"]
        return {"rows": rows if arguments["what"] == "names" else [], "next": None}

    def facts(self) -> dict[str, object]:
        """Return what it knows of a name: it is idle."""
        return {"name": self.label.encode().hex().ljust(64, "0"), "is_attached": True, "uptime_s": 60.0}

    def _ask(self, arguments: Mapping[str, object], respond: Respond) -> None:
        fields: dict[str, object] = {"id": arguments["id"], "rtt_ms": 1.5}
        self.asked.append(arguments)
        if arguments["ask"] == "state":
            respond(Response({**fields, "state": "answered", "role": self.role, "result": self.facts()}))
        elif arguments["ask"] == "resolve":
            respond(Response({**fields, "state": "answered", "result": {"places": self.places}}))
        elif self.is_silent or (self.is_ping_lost and arguments["ask"] == "ping"):
            respond(Response({**fields, "state": "silent"}))
        else:
            reply = answered(arguments)
            role = {"role": self.target_role} if reply["node"] == ROBOT else {}
            respond(Response({**fields, **reply, **role}))


def answered(arguments: Mapping[str, object]) -> dict[str, object]:
    """Return a reply: of the robot, two switches away; or of one of these."""
    hops = arguments.get("hops")
    is_trace = arguments["ask"] == "trace" and isinstance(hops, int) and hops <= 2
    result = {"in": {"port": "eth0", "to": OTHER}, "branches": [{"port": "eth1", "to": ROBOT, "role": "proxy"}]}
    return {
        "state": "answered",
        "node": f"{hops:064d}" if is_trace else ROBOT,
        "label": f"nuc{hops}" if is_trace else "robot",
        "role": "switch" if is_trace else "proxy",
        "domain": SCAN,
        "domain_label": "school",
        "switches": 2,
        "result": {} if hops == 2 or not is_trace else result,
        "withheld": is_trace and hops == 2,
        "cut": False,
        "error": "",
        "clock_offset_ms": 2_500.12,
        "clock_bound_ms": 0.7,
    }


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder in which the nodes of this machine have their sockets."""
    monkeypatch.setattr(running_nodes, "control_sockets", lambda: sorted(tmp_path.glob("*.sock")))
    return tmp_path


@pytest.fixture
def node(folder: Path) -> Iterator[Node]:
    made = Node("robot-proxy")
    with serve_control_in_thread(folder / "one.sock", made.handlers()):
        yield made


def gdp(*words: str) -> int:
    """Run a command; return its exit code."""
    try:
        main(words)
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


@pytest.mark.usefixtures("node")
def test_a_ping_prints_a_line_for_each_reply_and_a_summary(capsys: pytest.CaptureFixture[str]) -> None:
    assert gdp("ping", "/scan", "-c", "2", "-i", "0.05") == 0
    assert capsys.readouterr().out.splitlines() == [
        "reply 1 from robot (proxy, school): 1.50 ms, clock +2500.12 ± 0.70 ms",
        "reply 2 from robot (proxy, school): 1.50 ms, clock +2500.12 ± 0.70 ms",
        "--- /scan ---",
        "robot (proxy, school): 2 sent, 2 received, 0 % lost, min/median/p99/max 1.50/1.50/1.50/1.50 ms",
    ]


def test_a_ping_without_replies_exits_with_1(node: Node, capsys: pytest.CaptureFixture[str]) -> None:
    node.is_silent = True
    assert gdp("ping", SCAN, "-c", "1", "--json") == 1
    line, summary = map(json.loads, capsys.readouterr().out.splitlines())
    assert line == {"number": 1, "node": ROBOT, "rtt_ms": None}
    assert summary["members"][0]["loss"] == 1.0


def test_a_name_that_no_member_advertises_is_an_error(node: Node, capsys: pytest.CaptureFixture[str]) -> None:
    node.places = []
    assert gdp("ping", "/scan", "-c", "1") == 2
    assert "no RIB that answers knows a member that advertises it" in capsys.readouterr().err


@pytest.mark.usefixtures("node")
@pytest.mark.parametrize(("name", "words"), [("/none", "gdp show names"), ("/twice", "several names")])
def test_a_name_that_is_unknown_or_not_unique_is_refused(
    name: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert gdp("trace", name) == 2
    assert words in capsys.readouterr().err


@pytest.mark.usefixtures("node")
def test_a_trace_prints_the_switches_and_their_branches(capsys: pytest.CaptureFixture[str]) -> None:
    assert gdp("trace", "/scan") == 0
    *lines, last = capsys.readouterr().out.splitlines()
    assert lines == [
        "/scan, published by robot (proxy of school): 2 switches, 1.50 ms",
        "  1  nuc1  switch of school  1.50 ms  in eth0 0c0…c0c",
        "       tree -> eth1 aaa…aaa",
        "  2  a switch of school  1.50 ms  (tells our domain no more)",
    ]
    assert last.startswith("traced in ")


def test_a_trace_to_a_silent_member_exits_with_1(node: Node, capsys: pytest.CaptureFixture[str]) -> None:
    node.is_silent = True
    assert gdp("trace", "/scan", "--json") == 1
    (path,) = json.loads(capsys.readouterr().out)["paths"]
    assert (path["answered"], path["hops"]) == (False, [])


def test_a_trace_to_a_switch_ends_with_that_switch(node: Node) -> None:
    node.places, node.target_role = [{"node": ROBOT, "right": "attach"}], "switch"
    assert gdp("trace", ROBOT) == 0
    assert [each["hops"] for each in node.asked if "hops" in each] == [1, 2, 3]


@pytest.mark.parametrize(("role", "hops"), [("proxy", [1, 2]), ("switch", [1, 2, 3])])
def test_a_trace_whose_ping_is_lost_ends_at_the_member_that_answers(
    role: str, hops: list[int], node: Node, capsys: pytest.CaptureFixture[str]
) -> None:
    node.is_ping_lost, node.target_role = True, role
    assert gdp("trace", "/scan", "--json") == 0
    (path,) = json.loads(capsys.readouterr().out)["paths"]
    assert (path["answered"], path["label"], path["role"], path["rtt_ms"]) == (True, "robot", role, 1.5)
    assert [hop["hop"] for hop in path["hops"]] == hops


def test_a_switch_that_withholds_its_name_has_none_in_the_output(
    node: Node, capsys: pytest.CaptureFixture[str]
) -> None:
    del node
    gdp("trace", "/scan", "--json")
    (path,) = json.loads(capsys.readouterr().out)["paths"]
    assert (path["hops"][1]["withheld"], path["hops"][1]["node"], path["hops"][1]["label"]) == (True, None, None)


def test_several_nodes_need_a_choice(folder: Path, node: Node, capsys: pytest.CaptureFixture[str]) -> None:
    del node
    with serve_control_in_thread(folder / "two.sock", Node("arm-proxy").handlers()):
        assert gdp("ping", "/scan", "-c", "1") == 2
        assert "choose one with --node LABEL: arm-proxy (proxy), robot-proxy (proxy)" in capsys.readouterr().err
        for choice in ("arm-proxy", str(folder / "two.sock")):
            assert gdp("ping", "/scan", "-c", "1", "--node", choice) == 0
        assert gdp("ping", "/scan", "-c", "1", "--node", "nuc9") == 2
        assert "nuc9" in capsys.readouterr().err


@pytest.mark.usefixtures("folder")
def test_without_a_node_the_error_says_what_to_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert gdp("show", "names") == 2
    assert "--node DIR" in capsys.readouterr().err


@pytest.mark.usefixtures("node")
def test_a_table_in_a_pipe_loses_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert gdp("show", "names") == 0
    header, first, *_ = capsys.readouterr().out.splitlines()
    assert header.split() == ["NODE", "LOCAL", "NAME", "NOTE"]
    assert first.split() == ["robot-proxy", "/scan", SCAN, LONG]


@pytest.mark.usefixtures("node")
def test_columns_are_selected_and_unknown_ones_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert gdp("show", "names", "--columns", "name,local", "--node", "robot-proxy") == 0
    assert capsys.readouterr().out.splitlines()[1].split() == [SCAN, "/scan"]
    assert gdp("show", "names", "--columns", "color") == 2
    assert "the table has node, local, name, note" in capsys.readouterr().err


@pytest.mark.usefixtures("node")
def test_a_table_is_one_json_object(capsys: pytest.CaptureFixture[str]) -> None:
    assert gdp("show", "names", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["table"] == "names"
    assert shown["rows"][0] == {"node": "robot-proxy", "local": "/scan", "name": SCAN, "note": LONG}


def test_on_a_terminal_names_are_short_and_lines_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    out = Terminal()
    monkeypatch.setattr("sys.stdout", out)
    monkeypatch.setenv("COLUMNS", "40")
    tables.print_table([{"name": SCAN, "note": LONG}], ["name", "note"])
    lines = out.getvalue().splitlines()
    assert lines[1].startswith("0b0…b0b")
    assert max(map(len, lines)) <= 40


def test_quantiles_are_values_that_were_measured() -> None:
    times = [float(each) for each in range(1, 101)]
    assert (quantile(times, 0.5), quantile(times, 0.99), quantile([], 0.5)) == (50.0, 99.0, None)


def test_statistics_of_silence_have_no_times() -> None:
    assert PingStatistics(sent=2).to_text() == "2 sent, 0 received, 100 % lost"


def test_branches_below_are_indented() -> None:
    below: dict[str, Any] = {"state": "answered", "branches": [{"port": "p", "label": "robot"}]}
    hop = {"hop": 1, "state": "silent", "branches": [{"port": "q", "label": "nuc2", "rtt_us": 250, "below": below}]}
    below["branches"][0]["kbit_s"] = 420
    path = {"right": "serve", "node": ROBOT, "answered": False, "hops": [hop]}
    assert list(path_lines("/echo", path)) == [
        "/echo, served by aaa…aaa, which does not answer",
        "  1  no answer",
        "       tree -> q nuc2 0.25 ms",
        "           tree -> p robot, messages for 420 kbit/s",
    ]


def test_branches_that_a_right_would_show_are_mentioned() -> None:
    hop = {
        "hop": 1,
        "state": "answered",
        "label": "nuc2",
        "role": "switch",
        "domain_label": "lab",
        "needs_right": "not-delegated",
    }
    path = {"right": "publish", "node": ROBOT, "answered": False, "hops": [hop]}
    assert list(path_lines("/scan", path))[2:] == [
        "     branches are shown to switches, and to nodes with a right on the name"
    ]


class Refusing(Node):
    """A process that is no member, such as a relay: it refuses diagnostic requests and keeps no names."""

    def handlers(self) -> ControlHandlers:
        return ControlHandlers(
            reload=lambda: None, status=lambda: {"role": self.role, "name": SCAN, "pid": self.pid}, drain=lambda: None
        )


@pytest.fixture
def joined(folder: Path) -> Iterator[None]:
    """Let the processes of a machine that joined run: switch, proxy, and the relay of the switch's keys."""
    with ExitStack() as stack:
        for each in (Node("robot-proxy"), Node("robot-switch", "switch"), Refusing("robot-relay", "relay")):
            stack.enter_context(serve_control_in_thread(folder / f"{each.label}.sock", each.handlers()))
        yield


@pytest.mark.usefixtures("joined")
def test_a_machine_that_joined_gets_an_explanation(capsys: pytest.CaptureFixture[str]) -> None:
    assert gdp("explain", "/scan", "--seconds", "0.1") != 2
    out, err = capsys.readouterr()
    assert out
    assert "relay" not in out + err


@pytest.mark.usefixtures("joined")
def test_a_relay_that_carries_no_names_is_not_reported_as_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    gdp("topic", "list", "--seconds", "0.05")
    assert "relay" not in capsys.readouterr().err


@pytest.mark.usefixtures("joined")
def test_a_node_that_refuses_to_explain_is_listed_and_the_others_are_asked(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with serve_control_in_thread(folder / "rib.sock", Refusing("robot-rib", "rib").handlers()):
        assert gdp("explain", "/scan", "--seconds", "0.1") != 2
    assert f"not asked: rib {SCAN}: " in capsys.readouterr().out


@pytest.fixture
def server_elsewhere(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let a proxy run in another network namespace of this host."""
    server = Node("server-proxy")
    server.pid = 7
    monkeypatch.setattr(running_nodes, "_is_near", lambda pid: pid != server.pid)
    with serve_control_in_thread(folder / "two.sock", server.handlers()):
        yield


@pytest.mark.usefixtures("node", "server_elsewhere")
def test_every_command_asks_the_nodes_of_this_namespace(capsys: pytest.CaptureFixture[str]) -> None:
    assert gdp("show", "names") == 0
    assert "server-proxy" not in capsys.readouterr().out
    assert gdp("show", "names", "--host") == 0
    assert "server-proxy" in capsys.readouterr().out
    assert gdp("explain", "/scan", "--seconds", "0.1") != 2
    assert gdp("ping", "/scan", "-c", "1") == 0
    assert gdp("ping", "/scan", "-c", "1", "--node", "server-proxy") == 0
    assert len(local_nodes()) == len(running_nodes.find_running_nodes().nodes) == 1


@pytest.mark.usefixtures("server_elsewhere")
def test_where_no_node_runs_those_of_the_host_are_asked(capsys: pytest.CaptureFixture[str]) -> None:
    assert gdp("show", "names") == 0
    assert "server-proxy" in capsys.readouterr().out
    assert len(running_nodes.find_running_nodes().nodes) == 1


def test_columns_that_do_not_fit_are_left_out_whole_and_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "18")
    tables.print_table([{"port": "eth0", "loss_out": 0.25, "mtu": 1_500}], ["port", "loss_out", "mtu"])
    out, err = capsys.readouterr()
    assert [line.split() for line in out.splitlines()] == [["PORT", "LOSS_OUT"], ["eth0", "0.25"]]
    assert "left out, too wide: mtu" in err


def test_a_status_has_a_line_for_each_count_that_is_not_zero(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    counters = {"drops": {"no-reader": 3, "malformed": 0}, "sent": 0}
    handlers = ControlHandlers(
        reload=lambda: None, status=lambda: {"role": "switch", "counters": counters}, drain=lambda: None
    )
    with serve_control_in_thread(folder / "one.sock", handlers):
        assert gdp("status", "--socket", str(folder / "one.sock")) == 0
        lines = [line.split() for line in capsys.readouterr().out.splitlines()]
        assert [line for line in lines if line[0].startswith("counters")] == [["counters.drops.no-reader", "3"]]
        gdp("status", "--socket", str(folder / "one.sock"), "--all")
        assert ["counters.sent", "0"] in [line.split() for line in capsys.readouterr().out.splitlines()]


@pytest.mark.parametrize("words", [("up",), ("trace",), ("explain",)])
def test_help_breaks_lines_at_the_width_of_the_terminal_alone(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    gdp(*words, "--help")
    prose = [line.strip() for line in capsys.readouterr().out.split("Example")[0].splitlines()]
    for line, below in pairwise(prose):
        if line and below:
            assert len(f"{line} {below.split()[0]}") > 76, line
