"""``gdp ping``, ``gdp trace`` and ``gdp show`` on the ring and on a fog cluster.

How long each trace took is printed; ``pytest -s`` shows it. ``test_join.py`` traces through tunnels.
"""

from __future__ import annotations

import importlib.util
import json
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from fog_demo.cluster import STATE, standing_runs
from gdp.host.run_registry import RunRegistry
from gdp.management.control_client import NodeConnection, find_control_socket
from lab.machine import GDP, gdp
from netns_tests.test_fog_demo import command as fog_command
from netns_tests.test_ring import command as ring_command
from netns_tests.test_ring import make_demo
from tests.pages import ROOT

pytestmark = [pytest.mark.netns, pytest.mark.momentary("a request and its reply take milliseconds")]

PATIENCE_S = 120.0
RING_S = 60  # of traffic; the end of the tests ends it


@contextmanager
def running(argv: Sequence[str], is_ready: Callable[[str], bool]) -> Iterator[subprocess.Popen[str]]:
    """Run a demonstration from the line that says that it is ready; end it as Ctrl-C does."""
    with subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        seen: list[str] = []
        for line in process.stdout:
            seen.append(line)
            if is_ready(line):
                break
        else:
            raise AssertionError("".join(seen))
        reading = threading.Thread(target=process.stdout.read)  # so that it never waits for us
        reading.start()
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(PATIENCE_S)
            reading.join(PATIENCE_S)


def traced(where: str, name: str, node: Path) -> list[dict[str, Any]]:
    """Trace a name from a node, print how long that took, and return the paths."""
    result = json.loads(gdp("trace", name, "--node", node, "--json"))
    print(f"gdp trace through {where}: {result['elapsed_ms']} ms")
    paths: list[dict[str, Any]] = result["paths"]
    return paths


def labels(path: Mapping[str, object]) -> list[object]:
    """Return the switches of a path: labels, or the domain of one that tells no more."""
    hops = path["hops"]
    assert isinstance(hops, list)
    return [hop["label"] or hop["domain_label"] for hop in hops]


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Run the ring with a recording, and return the folder of its nodes."""
    demo = make_demo(tmp_path_factory.mktemp("demo"), 1)
    with running(ring_command(demo, "--seconds", RING_S), lambda line: "msg/s" in line) as process:
        (run,) = (each for each in RunRegistry().all() if each.owner.pid == process.pid)
        yield Path(run.files[0]) / "nodes"


def test_a_trace_from_the_server_shows_the_five_switches(ring: Path) -> None:
    (path,) = traced("the ring", "/scan", ring / "proxy-nuc5")
    assert path["answered"] is True
    assert path["label"] == "proxy-nuc1"
    assert labels(path) == ["switch-nuc5", "switch-nuc4", "backbone", "school", "school"]
    first, second = path["hops"][:2]
    assert (first["in"]["label"], first["out"]["label"]) == ("proxy-nuc5", "switch-nuc4")
    assert (first["out"]["port"], second["in"]["port"], second["out"]["port"]) == ("nuc4", "nuc5", "nuc3")
    assert [branch["label"] for branch in first["branches"]] == ["proxy-nuc5"]
    assert [branch["label"] for branch in second["branches"]] == ["switch-nuc5"]
    assert [hop["withheld"] for hop in path["hops"]] == [False, False, True, True, True]
    assert all(hop["rtt_ms"] > 0 for hop in path["hops"])


def test_a_trace_from_the_publisher_shows_the_tree_below_its_switch(ring: Path) -> None:
    (path,) = traced("the ring, from the publisher", "/scan", ring / "proxy-nuc1")
    assert labels(path) == ["switch-nuc1"]
    (branch,) = path["hops"][0]["branches"]
    assert branch["label"] == "switch-nuc2"
    (below,) = branch["below"]["branches"]
    assert (below["label"], below["below"]["withheld"]) == ("switch-nuc3", True)


def test_a_ping_comes_back_from_the_publisher(ring: Path) -> None:
    *replies, summary = map(
        json.loads, gdp("ping", "/scan", "--node", ring / "proxy-nuc5", "-c", 3, "-i", 0.05, "--json").splitlines()
    )
    assert [each["label"] for each in replies] == ["proxy-nuc1"] * 3
    assert replies[0]["result"] == {"rights": ["publish"]}
    (member,) = summary["members"]
    assert (member["sent"], member["received"], member["loss"]) == (3, 3, 0.0)


def test_ctrl_c_ends_a_ping_with_its_summary(ring: Path) -> None:
    argv = [*GDP, "ping", "/scan", "--node", str(ring / "proxy-nuc5"), "-i", "0.05"]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("reply 1 from proxy-nuc1 (proxy, school): ")
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert rest.splitlines()[-1].startswith("proxy-nuc1 (proxy, school): ")
    assert " 0 % lost, min/median/p99/max " in rest


def shown(node: Path, what: str) -> list[Mapping[str, object]]:
    """Return a table of a node, over its control socket."""
    with NodeConnection(find_control_socket(node)) as connection:
        return connection.show(what)


def test_every_table_is_kept_by_a_node_of_the_ring(ring: Path) -> None:
    switch, proxy, rib = (ring / each for each in ("switch-nuc2", "proxy-nuc5", "rib-nuc2"))
    neighbours = [(row["port"], row["neighbor"], row["state"]) for row in shown(switch, "neighbors")]
    assert neighbours == [("nuc1", "switch-nuc1", "up"), ("nuc3", "switch-nuc3", "up"), ("rib-s", "rib-nuc2", "up")]
    scan = next(row["name"] for row in shown(proxy, "names") if row["local"] == "/scan")
    assert any(row["topic"] == scan and row["to"] == "nuc3 switch-nuc3" for row in shown(switch, "trees"))
    assert any(row["destination"] == scan and row["kind"] == "tree" for row in shown(switch, "routes"))
    assert any(row["name"] == scan and row["domain"] == "school" for row in shown(rib, "names"))
    assert any(row["name"] == scan and row["is"] == "writer" for row in shown(proxy, "peers"))
    assert shown(switch, "tunnels") == []
    assert {row["role"] for row in shown(switch, "peers")} == {"switch", "rib"}
    assert all(isinstance(row["frames"], int) for row in shown(switch, "drops"))
    header, *rows = gdp("show", "links", "--node", switch, "--columns", "port,up").splitlines()
    assert header.split() == ["PORT", "UP"]
    assert sorted(row.split() for row in rows) == [["nuc1", "yes"], ["nuc3", "yes"], ["rib-s", "yes"]]


@pytest.mark.nightly
@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not installed: setup.sh --ros2")
def test_a_trace_in_a_fog_cluster_reaches_each_machine_that_serves() -> None:
    serving: set[str] = set()

    def are_serving(line: str) -> bool:
        serving.update(machine for machine in ("m1", "m2") if machine in line and "serving" in line)
        return len(serving) == 2

    with running(fog_command("--calm", 60), are_serving) as process:
        (run,) = (each for each in standing_runs("demo").all() if each.owner.pid == process.pid)
        paths = traced("a fog cluster", "/echo", Path(run.files[0]) / STATE / "robot" / "proxy")
    assert [path["right"] for path in paths] == ["serve", "serve"]
    assert all(path["answered"] for path in paths)
    assert {tuple(labels(path)) for path in paths} == {("robot", "gateway-gateway", f"echo-{each}") for each in serving}
    assert {str(path["hops"][-1]["out"]["role"]) for path in paths} == {"proxy"}
