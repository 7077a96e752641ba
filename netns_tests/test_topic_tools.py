"""``gdp topic``, ``service``, ``top`` and ``rib`` on a real switch, RIB, proxy and ROS 2 node, by the command line."""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import sys
from collections.abc import Iterator
from typing import Final

import pytest
import yaml

from gdp.trust.right import Right
from lab.machine import GDP
from netns_tests.session_lab import PATIENCE_S, SessionLab, lines_of, session_lab
from tests.proxy.endpoints.ros2_net import needs

needs("std_msgs", "std_srvs")
pytestmark = [pytest.mark.netns, pytest.mark.momentary("about tools, no lease matters")]

STRING, SET_BOOL, TRIGGER = "std_msgs/msg/String", "std_srvs/srv/SetBool", "std_srvs/srv/Trigger"
TYPES: Final = {"/chat": STRING, "/lamp": SET_BOOL, "/go": TRIGGER, "/secret": STRING}
RIGHTS: Final = {
    "robot": {"/chat": [Right.PUBLISH], "/secret": [Right.PUBLISH], "/lamp": [Right.SERVE], "/go": [Right.SERVE]},
    "viewer": {"/chat": [Right.READ], "/lamp": [Right.CALL], "/go": [Right.CALL]},
}
DOMAIN: Final = 77
HZ: Final = 20
MEASURED_S: Final = "6"  # a busy machine takes seconds to subscribe
ENVIRONMENT: Final = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
ROBOT: Final = f"""
import rclpy
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
rclpy.init(domain_id={DOMAIN})
node = rclpy.create_node("robot")
def answer(request, response):
    response.success, response.message = request.data, "lamp"
    return response
def go(request, response):
    response.success, response.message = True, "gone"
    return response
node.create_service(SetBool, "/lamp", answer)
node.create_service(Trigger, "/go", go)
publishers = [node.create_publisher(String, topic, 10) for topic in ("/chat", "/secret")]
count = 0
def tick():
    global count
    count += 1
    for publisher in publishers:
        publisher.publish(String(data=f"message {{count}}: " + "x" * 200))
node.create_timer(1 / {HZ}, tick)
print("ready", flush=True)
rclpy.spin(node)
"""


@pytest.fixture(scope="module")
def lab() -> Iterator[SessionLab]:
    kept = {key: os.environ.get(key) for key in ENVIRONMENT}
    os.environ.update(ENVIRONMENT)  # of the processes that the lab starts
    try:
        with session_lab(RIGHTS, TYPES) as lab:
            rules = [
                {"name": name, "type": type_name, "kind": "service" if "srv" in type_name else "topic",
                 "owner": "owner/owner.pub"}
                for name, type_name in TYPES.items()
            ]  # fmt: skip
            config = {
                "identity": "robot", "domain": {"root": "domain/root.crt"}, "iface": "robot0",
                "delegations": "robot/delegations", "ros": [{"endpoint": "ros2", "domain": DOMAIN}], "expose": rules,
            }  # fmt: skip
            (lab.folder / "robot.yaml").write_text(yaml.safe_dump(config))
            robot = lab.python("-c", ROBOT)
            assert lines_of(robot, 1) == ["ready"]
            proxy = lab.python("-m", "proxy.cli.proxy", "--config", "robot.yaml", "--json")
            while '"ready"' not in lines_of(proxy, 1)[0]:
                assert proxy.code is None, proxy.logged
            # DDS takes up to seconds to find the robot: what waits for its first message says so
            assert gdp(lab, "topic", "echo", "/chat", "--node", "viewer", "--once")[0] == 0
            yield lab
    finally:
        for key, value in kept.items():
            if value is None:
                del os.environ[key]
            else:
                os.environ[key] = value


def gdp(lab: SessionLab, *words: str) -> tuple[int, str, str]:
    """Run ``gdp`` on the lab's machine; return exit code, output and errors."""
    done = lab.run(*GDP, *words)
    return done.returncode, done.stdout, done.stderr


def rows(text: str) -> list[dict[str, object]]:
    """Return the objects of lines of JSON."""
    return [json.loads(line) for line in text.splitlines()]


def test_echo_prints_a_message_as_ros2_does(lab: SessionLab) -> None:
    code, out, errors = gdp(lab, "topic", "echo", "/chat", "--node", "viewer", "--once", "-l", "12")
    assert (code, errors) == (0, "")
    text, end = out.split("---\n")
    assert yaml.safe_load(text)["data"].startswith("message ")
    assert len(yaml.safe_load(text)["data"]) == 12 + len("...")
    assert end == ""


def test_echo_prints_whole_messages_as_lines_of_json(lab: SessionLab) -> None:
    code, out, _ = gdp(lab, "topic", "echo", "/chat", "--node", "viewer", "--json", "-n", "3")
    found = rows(out)
    assert (code, len(found)) == (0, 3)
    assert {(row["topic"], row["type"]) for row in found} == {("/chat", STRING)}
    assert all(len(row["message"]["data"]) > 200 for row in found)  # type: ignore[index]


def test_a_reader_of_a_pipe_that_leaves_ends_echo(lab: SessionLab) -> None:
    command = f"{sys.executable} -m gdp.cli.gdp topic echo /chat --node viewer | head -n 1"
    done = lab.run("bash", "-o", "pipefail", "-c", command)
    assert (done.returncode, done.stdout.startswith("data: "), done.stderr) == (0, True, "")


def test_echo_without_the_right_states_what_the_owner_types(lab: SessionLab) -> None:
    code, out, errors = gdp(lab, "topic", "echo", "/secret", "--node", "viewer", "--type", STRING)
    assert (code, out) == (2, "")
    command = next(line for line in errors.splitlines() if "gdp delegate name" in line).split()
    given = [*command[1:], "--force"]
    given[given.index("OWNER")] = "owner"
    assert gdp(lab, *given)[0] == 0  # typed by the owner as it stands there
    assert gdp(lab, "delegate", "install", "secret.delegation", "--node", "viewer")[0] == 0
    assert gdp(lab, "topic", "echo", "/secret", "--node", "viewer", "--once")[0] == 0


def test_hz_states_a_rate_between_its_shortest_and_its_longest_gap(lab: SessionLab) -> None:
    code, out, _ = gdp(lab, "topic", "hz", "/chat", "--node", "viewer", "--duration", MEASURED_S, "--json")
    last = json.loads(out.splitlines()[-1])
    assert code == 0
    assert last["min_s"] <= 1 / last["rate_hz"] <= last["max_s"]
    assert last["window"] > 2


def first_report(lab: SessionLab, tool: str) -> str:
    """Return the first report of a tool that runs until Ctrl-C, which is two lines."""
    measuring = lab.python("-m", "gdp.cli.gdp", "topic", tool, "/chat", "--node", "viewer")
    lines = [measuring.read_line(PATIENCE_S).decode() for _ in range(2)]
    measuring.finish()
    return "\n".join(lines)


def test_hz_and_bw_print_the_lines_of_ros2(lab: SessionLab) -> None:
    out = first_report(lab, "hz")
    assert out.startswith("average rate: ")
    assert "\tmin: " in out
    assert " std dev: " in out
    assert " window: " in out
    out = first_report(lab, "bw")
    assert "/s from " in out
    assert "\tMessage size mean: " in out


def test_list_joins_what_proxy_and_switch_know(lab: SessionLab) -> None:
    code, out, _ = gdp(lab, "topic", "list", "--json", "--seconds", "0.5")
    found = {(str(row["topic"]), str(row["role"])): row for row in rows(out)}
    assert code == 0
    chat = found["/chat", "proxy"]
    assert (chat["type"], chat["direction"], chat["publishers"]) == (STRING, "out", 1)
    assert float(str(chat["messages_s"])) > 0
    assert float(str(chat["size_bytes"])) > 200
    assert found["/chat", "switch"]["direction"] == "through"  # by the name that the proxy lends
    assert found["/lamp", "proxy"]["kind"] == "service"


def test_info_counts_the_readers_of_a_topic(lab: SessionLab) -> None:
    reader = lab.python("-m", "gdp.cli.gdp", "topic", "echo", "/chat", "--node", "viewer", "--json")
    lines_of(reader, 1)
    code, out, _ = gdp(lab, "topic", "info", "/chat", "--json", "--seconds", "0.2")
    reader.finish(signal.SIGTERM)
    found = {(row["role"], row["direction"]): row for row in rows(out)}
    assert code == 0
    assert found["proxy", "out"]["readers"] == 1
    assert found["proxy", "in"]["publishers"] == 1
    assert gdp(lab, "topic", "info", "/nowhere")[0] == 1


def test_a_service_is_called_and_states_its_replica(lab: SessionLab) -> None:
    code, out, errors = gdp(lab, "service", "call", "/lamp", SET_BOOL, "{data: true}", "--node", "viewer", "--json")
    assert (code, errors) == (0, "")
    (answer,) = rows(out)
    assert answer["response"] == {"success": True, "message": "lamp"}
    assert answer["server"] == json.loads(gdp(lab, "status", "robot", "--json")[1])["name"]


def test_a_service_whose_request_has_no_fields_is_called(lab: SessionLab) -> None:
    code, out, errors = gdp(lab, "service", "call", "/go", TRIGGER, "{}", "--node", "viewer", "--json")
    assert (code, errors) == (0, "")
    assert rows(out)[0]["response"] == {"success": True, "message": "gone"}


def test_a_call_that_cannot_be_made_says_why(lab: SessionLab) -> None:
    code, _, errors = gdp(lab, "service", "call", "/lamp", SET_BOOL, "{dat: true}", "--node", "viewer")
    assert (code, "there is no field dat; it has data" in errors) == (2, True)
    code, _, errors = gdp(lab, "service", "call", "/gate", SET_BOOL, "{}", "--node", "viewer")
    assert (code, "--right call --kind service --name /gate" in errors) == (2, True)


def test_top_prints_lines_in_a_pipe_and_a_view_in_a_terminal(lab: SessionLab) -> None:
    code, out, _ = gdp(lab, "top", "--once", "--interval", "0.5")
    assert code == 0
    assert out.splitlines()[0].split()[:3] == ["NAME", "DIRECTION", "MSG/S"]
    _, out, _ = gdp(lab, "top", "--json", "-n", "2", "--interval", "0.3")
    assert len({row["at_unix_s"] for row in rows(out)}) == 2
    ours, theirs = pty.openpty()
    process = lab.launch(
        ["bash", "-c", f"{sys.executable} -m gdp.cli.gdp top -n 2 --interval 0.3 < /dev/null > {os.ttyname(theirs)}"]
    )
    drawn = ""
    while process.code is None or select.select([ours], [], [], 0)[0]:
        if select.select([ours], [], [], 0.1)[0]:
            drawn += os.read(ours, 1 << 16).decode(errors="replace")
    os.close(theirs)
    os.close(ours)
    assert process.code == 0
    assert "/chat" in drawn
    assert "\x1b[?1049h" in drawn  # the terminal's other screen, which is left at the end


def test_rib_lookup_states_who_advertises_a_name(lab: SessionLab) -> None:
    code, out, _ = gdp(lab, "rib", "lookup", "/chat", "--json")
    asked = json.loads(out)
    (answer,) = asked["asked"]
    assert (code, answer["role"], answer["state"]) == (0, "switch", "answered")
    (row,) = [row for row in answer["advertisers"] if row["right"] == "publish"]
    assert (row["holder"], row["switch"]) == ("robot", answer["node"])
    assert row["left_s"] > 0
    assert answer["rib"] == json.loads(gdp(lab, "status", "rib", "--json")[1])["name"]
    code, out, _ = gdp(lab, "rib", "lookup", asked["name"], "--node", "rib")
    assert (code, "stored" in out, "delegated   by the owner" in out) == (0, True, True)


def test_a_name_that_no_node_advertises_has_exit_code_1(lab: SessionLab) -> None:
    code, out, _ = gdp(lab, "rib", "lookup", "ab" * 32)
    assert (code, "no node advertises it" in out) == (1, True)


def test_completion_offers_the_names_of_running_nodes(lab: SessionLab) -> None:
    words = {"_GDP_COMPLETE": "complete_bash", "COMP_WORDS": "gdp topic info /ch", "COMP_CWORD": "3"}
    command = [f"{key}={value}" for key, value in words.items()]
    assert lab.output("env", *command, *GDP).split() == ["/chat"]
