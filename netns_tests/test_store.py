"""History of a topic on real processes: replayed without a reader, held by a holder, exported byte for byte."""

from __future__ import annotations

import json
import shutil
import signal
import sys
from collections.abc import Collection
from pathlib import Path

import pytest

from gdp.crypto.certificates import Role
from gdp.stores.keyring import OWNER_PUBLIC
from gdp.trust.right import Right
from lab.credentials import make_nodes
from lab.machine import GDP
from lab.process import LabProcess, until
from netns_tests.session_lab import PATIENCE_S, SessionLab, lines_of, session_lab
from proxy.recordings.reader import BagReader
from tests.gdp.stores.bucket_sites import NAME, environment
from tests.pages import ROOT

pytestmark = pytest.mark.netns

TOPICS = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/camera/image": "sensor_msgs/msg/Image",
}
RIGHTS: dict[str, dict[str, Collection[Right]]] = {
    "robot": {**dict.fromkeys(TOPICS, (Right.PUBLISH,)), "store": [Right.CALL]},
    "holder": {"store": [Right.SERVE]},
    "investigator": {**dict.fromkeys(TOPICS, (Right.READ,)), "store": [Right.CALL]},
}


TWO: dict[str, dict[str, Collection[Right]]] = {
    "robot": {"/scan": [Right.PUBLISH], "store-a": [Right.CALL], "store-b": [Right.CALL]},
    "holder": {"store-a": [Right.SERVE], "store-b": [Right.CALL]},
    "second": {"store-b": [Right.SERVE], "store-a": [Right.CALL]},
}


def content(path: Path) -> dict[str, list[bytes]]:
    """Return the messages of each topic of a recording, in order; a replay gives them stamps of its own."""
    found: dict[str, list[bytes]] = {}
    with BagReader(path) as reader:
        for each in reader.messages():
            found.setdefault(reader.channels[each.channel].topic, []).append(each.raw)
        assert reader.unread == ""
    return {topic: found[topic] for topic in TOPICS}


def robot(lab: SessionLab, topics: Collection[str] = tuple(TOPICS), to: object = "store") -> Path:
    """Write the robot's configuration; return it."""
    (lab.folder / "state").mkdir()
    owner = str(lab.folder / "owner" / OWNER_PUBLIC)
    alone = {"disk": "200MB", "to": to}
    keeps = {"/tf": {**alone, "capsule": "drive"}, "/scan": {**alone, "capsule": "drive"}}
    rules = [
        {"name": name, "type": type_name, "owner": owner, "keep": keeps.get(name, alone)}
        for name, type_name in TOPICS.items()
        if name in topics
    ]
    return lab.write(
        "robot", "robot", iface="robot0", delegations="robot/delegations", state="state", expose=rules, sandbox=False
    )


def test_a_replayed_drive_is_exported_as_it_was_recorded(tmp_path: Path) -> None:
    with session_lab(RIGHTS, TOPICS) as lab:
        drive, store, incident = lab.folder / "drive.mcap", lab.folder / "capsules", lab.folder / "incident.mcap"
        lab.output(sys.executable, str(ROOT / "scripts/make_demo_bag.py"), "--seconds", "2", "-o", str(drive))
        holder = lab.launch(["gdp", "store", "serve", "holder", "--store", str(store), "--json"])
        assert '"ready"' in lines_of(holder, 1)[0]
        config = robot(lab)
        done = lab.run(
            "gdp-replay", str(drive), "--config", str(config), "--rate", "0", "--wait-readers", "0", "--json"
        )
        assert done.returncode == 0, done.stdout + done.stderr
        said = json.loads(done.stdout.splitlines()[-1])
        assert (said["event"], said["unconfirmed"]) == ("done", [])
        assert {each["topic"] for each in said["held"]} == set(TOPICS)
        assert all(each["messages"] and each["bytes"] and each["holders"] == 1 for each in said["held"])
        exported = lab.run("gdp", "store", "export", *TOPICS, "--node", "investigator", "-o", str(incident), "--json")
        assert exported.returncode == 0, exported.stdout + exported.stderr
        assert content(incident) == content(drive)
        lines = lab.output("gdp", "store", "ls", "--store", str(store), "--json").splitlines()
        listed = [json.loads(line) for line in lines]
        assert sorted(len(each["topics"]) for each in listed) == [1, 2]
        for each in listed:
            lab.output("gdp", "store", "verify", each["capsule"], "--store", str(store))
        holder.finish(signal.SIGTERM)
        data = bytearray((segment := next(store.rglob("*.records"))).read_bytes())
        data[len(data) // 2] ^= 1
        segment.write_bytes(data)
        verified = lab.run("gdp", "store", "verify", segment.parent.name, "--store", str(store))
        assert verified.returncode == 1
        assert "altered" in verified.stdout


def test_a_holder_with_an_empty_disk_has_what_its_bucket_has(tmp_path: Path) -> None:
    pytest.importorskip("moto.server", reason="moto of the extra `dev` is not installed")
    with session_lab(RIGHTS, TOPICS) as lab:
        drive, incident = lab.folder / "drive.mcap", lab.folder / "incident.mcap"
        lab.environment.update(environment("http://127.0.0.1:5000", lab.folder))
        s3 = lab.launch([sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", "5000"], "s3", heard=False)
        s3.until_logged("Running on")
        lab.output(sys.executable, "-c", f"import boto3; boto3.client('s3').create_bucket(Bucket={NAME!r})")
        lab.output(str(ROOT / "scripts/make_demo_bag.py"), "--seconds", "2", "-o", str(drive))
        words = ["--bucket", f"s3://{NAME}/robots", "--upload", "1", "--json"]

        def serve(store: str) -> LabProcess:
            holder = lab.launch(["gdp", "store", "serve", "holder", "--store", str(lab.folder / store), *words])
            assert '"ready"' in lines_of(holder, 1)[0]
            return holder

        first = serve("first")
        replay = ["gdp-replay", str(drive), "--config", str(robot(lab)), "--rate", "0", "--wait-readers", "0", "--json"]
        done = lab.run(*replay)
        assert done.returncode == 0, done.stdout + done.stderr
        assert json.loads(done.stdout.splitlines()[-1])["unconfirmed"] == []
        lab.kill(first)
        shutil.rmtree(lab.folder / "first")
        second = serve("second")
        exported = lab.run("gdp", "store", "export", *TOPICS, "--node", "investigator", "-o", str(incident), "--json")
        assert exported.returncode == 0, exported.stdout + exported.stderr
        assert content(incident) == content(drive)
        other = ["gdp", "store", "serve", "robot", "--store", str(lab.folder / "third"), *words]
        refused = lab.run(*other)
        assert refused.returncode
        assert "uses it; give each holder a prefix of its own" in refused.stderr
        for each in lab.output("gdp", "store", "ls", "--store", str(lab.folder / "second"), "--json").splitlines():
            lab.output("gdp", "store", "verify", json.loads(each)["capsule"], "--store", str(lab.folder / "second"))
        second.finish(signal.SIGTERM)


KEEPING = """
import sys, time, gdp

try:
    with gdp.open("robot") as session:
        session.publisher("/scan", keep=["store"])
except gdp.LocalError as error:
    print(error)
with gdp.open("robot", state="state") as session:
    with session.publisher("/scan", keep=["store"]) as publisher:
        for number in range(int(sys.argv[1]), int(sys.argv[2])):
            publisher.put(b"%d" % number)
        end_s = time.monotonic() + float(sys.argv[3])
        while not publisher.is_kept and time.monotonic() < end_s:
            time.sleep(0.05)
        print(publisher.is_kept, flush=True)
"""
READING = """
import gdp
from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.reading import CapsuleReader
from gdp.session.protocol.wire import read_message
from gdp.trust.right import Right

with gdp.open("investigator") as session:
    topic = session.core.resolve("/scan", Right.READ)

    def ask(request):
        return HolderAnswer.from_cbor(session.call("store", request.to_cbor(), replication=1).payload)

    (about,) = ask(HolderRequest(ask=Ask.LIST, topic=topic.name)).descriptors
    reader = CapsuleReader(about, {topic.name: topic.secrets})
    while not reader.is_done:
        for kept in reader.handle_response(ask(reader.next_request())):
            print(read_message(kept.message)[1].decode())
    print(reader.audit.findings)
"""


def test_a_program_keeps_what_it_publishes_and_the_next_one_uploads_what_the_first_could_not(tmp_path: Path) -> None:
    with session_lab(RIGHTS, TOPICS) as lab:
        (lab.folder / "state").mkdir()
        missing, alone = lab.output(sys.executable, "-c", KEEPING, "0", "300", "0.5").splitlines()
        assert "state of the session is missing" in missing
        assert alone == "False"
        store = lab.folder / "capsules"
        holder = lab.launch(["gdp", "store", "serve", "holder", "--store", str(store), "--json"])
        assert '"ready"' in lines_of(holder, 1)[0]
        assert lab.output(sys.executable, "-c", KEEPING, "300", "400", "20").splitlines()[-1] == "True"
        *read, findings = lab.output(sys.executable, "-c", READING).splitlines()
        assert read == [str(each) for each in range(400)]
        assert findings == "[]"


def test_two_holders_are_equal_and_one_repairs_the_segment_of_the_other(tmp_path: Path) -> None:
    with session_lab(TWO, TOPICS) as lab:
        drive, (first, second) = lab.folder / "drive.mcap", (lab.folder / "a", lab.folder / "b")
        lab.output(sys.executable, str(ROOT / "scripts/make_demo_bag.py"), "--seconds", "2", "-o", str(drive))

        def serve(node: str, own: str, other: str, store: Path) -> LabProcess:
            holder = lab.launch(
                ["gdp", "store", "serve", node, "--service", own, "--peer", other, "--store", str(store), "--json"]
            )
            assert '"ready"' in lines_of(holder, 1)[0]
            return holder

        one, two = serve("holder", "store-a", "store-b", first), serve("second", "store-b", "store-a", second)
        config = robot(lab, ["/scan"], ["store-a", "store-b"])
        done = lab.run(
            "gdp-replay", str(drive), "--config", str(config), "--rate", "0", "--wait-readers", "0", "--json"
        )
        assert done.returncode == 0, done.stdout + done.stderr

        def are_equal() -> bool:
            held = [[each.read_bytes() for each in store.rglob("*.records")] for store in (first, second)]
            return len(held[0]) == 1 and held[0] == held[1]

        until(are_equal, lambda: f"not equal: {one.logged} {two.logged} {done.stdout} {done.stderr}", PATIENCE_S)
        (segment,) = first.rglob("*.records")
        data = segment.read_bytes()
        one.finish(signal.SIGTERM)
        segment.write_bytes(bytes([*data[:900], data[900] ^ 1, *data[901:]]))
        one = serve("holder", "store-a", "store-b", first)
        words = [json.loads(line)["detail"] for line in lines_of(one, 2)]
        assert "repaired from store-b" in words[-1]
        assert segment.read_bytes() == data
        two.finish(signal.SIGTERM)


def test_gdp_up_runs_the_holder_of_a_machine(tmp_path: Path) -> None:
    with session_lab({}) as lab:
        nodes = {"switch": Role.SWITCH, "rib": Role.RIB, "store": Role.PROXY, "robot": Role.PROXY}
        rights: dict[str, dict[str, Collection[Right]]] = {
            "robot": {"/scan": [Right.PUBLISH], "store": [Right.CALL]},
            "store": {"store": [Right.SERVE]},
        }
        make_nodes(lab.folder, nodes, rights, TOPICS)
        drive, store = lab.folder / "drive.mcap", lab.folder / "capsules"
        machine = lab.folder / "machine.yaml"
        switch = "switch: {data_plane: raw, attach: [rib0, store0, robot0]}\nrib:\n"
        machine.write_text(f"{switch}store: {{holds: {{folder: capsules}}}}\n")
        refused = lab.run(*GDP, "up", str(lab.folder), "--no-systemd")
        assert refused.returncode == 2
        assert "machine.yaml:3:25: holds.folder: no such directory" in refused.stderr
        store.mkdir()
        both = lab.run(*GDP, "store", "serve", "--config", str(machine), "--store", str(store))
        assert (both.returncode, "leave out NODE and the options" in both.stderr) == (2, True)
        lab.output(sys.executable, str(ROOT / "scripts/make_demo_bag.py"), "--seconds", "2", "-o", str(drive))
        up = lab.launch([*GDP, "up", str(lab.folder), "--no-systemd"], "up")
        up.until_logged(r"^store  \| holder .* serves store")
        done = lab.run(
            "gdp-replay", str(drive), "--config", str(robot(lab, ["/scan"])), "--rate", "0", "--wait-readers", "0"
        )
        assert (done.returncode, "/scan" in done.stdout) == (0, True), done.stdout + done.stderr
        assert "messages without a reader; its holder has its capsule" in done.stdout
        (listed,) = lab.output("gdp", "store", "ls", "--store", str(store), "--json").splitlines()
        assert json.loads(listed)["head"] > 0
        up.finish()
        assert up.code == 0, up.logged
        assert [line.split()[0] for line in up.logged.splitlines() if "stopping signal=2" in line] == ["rib", "switch"]
