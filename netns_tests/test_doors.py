"""Doors on real devices: a replayed recording reaches WebSocket clients through a switch, and nothing else does."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator

import pytest
import yaml

from gdp.trust.right import Right
from netns_tests.session_lab import SessionLab, lines_of, session_lab
from tests.pages import ROOT

pytest.importorskip("websockets")

pytestmark = pytest.mark.netns

TYPES = {"/camera/image": "sensor_msgs/msg/Image", "/odom": "nav_msgs/msg/Odometry", "/tf": "tf2_msgs/msg/TFMessage"}
RIGHTS = {
    "robot": {name: [Right.PUBLISH] for name in TYPES},
    "viewer": {"/camera/image": [Right.READ], "/odom": [Right.READ]},
}
CLIENT = """
import json, ssl, struct, sys
from websockets.sync.client import connect
context = ssl.create_default_context(cafile=sys.argv[2])
with connect(sys.argv[1], ssl=context, subprotocols=["foxglove.websocket.v1"], max_size=None) as socket:
    print(json.loads(socket.recv())["op"], flush=True)
    channels = {}
    while len(channels) < 2:
        message = json.loads(socket.recv())
        if message["op"] == "advertise":
            channels |= {each["topic"]: each for each in message["channels"]}
    print(json.dumps({topic: [each["schemaName"], each["schemaEncoding"], len(each["schema"]) > 100]
                      for topic, each in sorted(channels.items())}), flush=True)
    names = {}
    for number, (topic, each) in enumerate(sorted(channels.items())):
        names[number] = topic
        socket.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": number, "channelId": each["id"]}]}))
    socket.send(json.dumps({"op": "advertise", "channels": [
        {"id": 9, "topic": "/cmd_vel", "encoding": "cdr", "schemaName": "geometry_msgs/msg/Twist"}]}))
    counts, sizes = {topic: 0 for topic in names.values()}, {topic: 0 for topic in names.values()}
    while counts["/camera/image"] < 20 or counts["/odom"] < 40:
        message = socket.recv(timeout=20)
        if isinstance(message, str):
            print(message, flush=True)
            continue
        opcode, number, stamp = struct.unpack_from("<BIQ", message)
        assert opcode == 1 and message[13:17] == b"\\0\\1\\0\\0" and stamp > 10**18
        counts[names[number]] += 1
        sizes[names[number]] += len(message) - 13
    print(json.dumps([counts, sizes]), flush=True)
"""


@pytest.fixture(scope="module")
def lab() -> Iterator[SessionLab]:
    with session_lab(RIGHTS, TYPES) as lab:
        bag = lab.folder / "drive.mcap"
        subprocess.run(
            [sys.executable, str(ROOT / "scripts/make_demo_bag.py"), "--seconds", "2", "-o", str(bag)], check=True
        )
        _configure(lab, "all", "/camera/image", "/odom")
        _configure(lab, "odom", "/odom")
        yield lab


def _configure(lab: SessionLab, label: str, *names: str) -> None:
    """Write the configuration of a replay of these topics."""
    config = {
        "identity": "robot",
        "domain": {"root": "domain/root.crt"},
        "iface": "robot0",
        "delegations": "robot/delegations",
        "expose": [{"name": name, "type": TYPES[name], "owner": "owner/owner.pub", "reliable": True} for name in names],
    }
    (lab.folder / f"{label}.yaml").write_text(yaml.safe_dump(config))


def test_a_replayed_recording_reaches_a_foxglove_client_whole_through_tls(lab: SessionLab) -> None:
    words = ["--domain", "domain", "--request", "viewer/node.csr", "--host", "127.0.0.1", "--out", "door.crt"]
    lab.gdp("cert", "door", *words)
    door = lab.python("-m", "gdp.cli.gdp", "foxglove", "viewer", "--tls", "door.crt", "--json")
    ready = json.loads(lines_of(door, 1)[0])
    assert (ready["event"], sorted(ready["reads"])) == ("ready", ["/camera/image", "/odom"])
    client = lab.python("-c", CLIENT, ready["url"], "domain/root.crt")
    info, channels = lines_of(client, 2)
    assert info == "serverInfo"
    assert json.loads(channels) == {
        name: [TYPES[name], "ros2msg", True] for name in RIGHTS["viewer"]
    }  # and not /tf, for which the door has no delegation
    (status,) = lines_of(client, 1)
    assert "gdp delegate name --right publish --kind topic --name /cmd_vel" in json.loads(status)["message"]
    replay = lab.python("-m", "proxy.cli.replay", "drive.mcap", "--config", "all.yaml")
    replay.output()
    counts, sizes = json.loads(client.output().splitlines()[-1])
    assert counts == {"/camera/image": 20, "/odom": 40}
    assert sizes["/camera/image"] > 20 * 640 * 480
    assert json.loads(door.finish().splitlines()[-1])["dropped"] == 0


ROSLIBPY = """
import json, sys, threading, roslibpy
ros = roslibpy.Ros(sys.argv[1])
ros.run(20)
waiting = threading.Semaphore(0)
got = []
def hear(message):
    got.append(message)
    waiting.release()
topic = roslibpy.Topic(ros, "/odom", "nav_msgs/Odometry")
topic.subscribe(hear)
print("ready", flush=True)
for _ in range(40):
    assert waiting.acquire(timeout=25)
print(json.dumps([len(got), got[0]["header"]["frame_id"], ros.get_topics(), ros.get_topic_type("/odom")]), flush=True)
try:
    roslibpy.Service(ros, "/reset", "std_srvs/Trigger").call(roslibpy.ServiceRequest())
except Exception as error:
    print(error, flush=True)
ros.terminate()
"""


def test_a_replayed_recording_reaches_roslibpy(lab: SessionLab) -> None:
    pytest.importorskip("roslibpy")
    door = lab.python("-m", "gdp.cli.gdp", "rosbridge", "viewer", "--json")
    ready = json.loads(lines_of(door, 1)[0])
    assert ready["event"] == "ready"
    client = lab.python("-c", ROSLIBPY, ready["url"])
    assert lines_of(client, 1) == ["ready"]
    replay = lab.python("-m", "proxy.cli.replay", "drive.mcap", "--config", "odom.yaml")
    replay.output()
    heard, error = client.output().splitlines()
    count, frame, topics, type_name = json.loads(heard)
    assert (count, frame, type_name) == (40, "odom", TYPES["/odom"])
    assert sorted(topics) == ["/camera/image", "/odom"]
    assert "gdp delegate name --right call --kind service --name /reset" in error
