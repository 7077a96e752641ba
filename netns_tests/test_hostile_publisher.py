"""Hostile publisher of one topic on a real switch: a real ``gdp-proxy`` goes on with another topic."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from typing import Final

import pytest
import yaml

from gdp.trust.right import Right
from netns_tests.session_lab import SessionLab, lines_of, session_lab

pytestmark = [pytest.mark.netns, pytest.mark.momentary("about one input, no lease matters")]

TYPES: Final = {"/chatter": "a/msg/B", "/good": "a/msg/B"}
RIGHTS: Final = {
    "robot": {"/chatter": [Right.PUBLISH]},
    "other": {"/good": [Right.PUBLISH]},
    "recorder": {name: [Right.READ] for name in TYPES},
}
# A node with every right that sends what no proxy of ours would; each description ended a proxy once.
PUBLISHER: Final = """
import sys, time
import cbor2, gdp
from proxy.serial.channel import Channel
from proxy.wire.message import RosMessage, Step, TopicDescription

label, name = sys.argv[1:]
channel = Channel(name, "a/msg/B", 2, definition="bool[0] a\\nint8 b\\n", definition_format="msg")
good = TopicDescription("json", (channel,)).to_wire()
broken = bytes.fromhex("37a430ec") + bytes([255] * 200)
dictionary = TopicDescription("cdr", (channel,), is_compressed=True, dictionary=broken).to_wire()
image = cbor2.dumps(cbor2.loads(good) | {"i": {}}, canonical=True)
valid = RosMessage(0, time.time_ns(), b'{"a":[],"b":1}').to_wire()
packed = RosMessage(0, time.time_ns(), bytes(40), Step.ZSTD).to_wire()
said = [(good, valid)] if label == "other" else [(dictionary, packed), (image, valid), (good, valid)]
with gdp.open(label) as session:
    publisher = session.publisher(name, description=said[0][0])
    publisher.wait_for_readers(timeout_s=20)
    for description, wire in said:
        publisher._publisher.describe(description)
        publisher._driver.publish(publisher._publisher, wire)
        publisher.flush(20)
"""


@pytest.fixture
def lab() -> Iterator[SessionLab]:
    with session_lab(RIGHTS, TYPES) as lab:
        yield lab


def test_a_publisher_of_broken_descriptions_ends_no_proxy_and_no_other_topic(lab: SessionLab) -> None:
    rules = [{"name": name, "type": type_name, "owner": "owner/owner.pub"} for name, type_name in TYPES.items()]
    config = {
        "identity": "recorder",
        "domain": {"root": "domain/root.crt"},
        "iface": "recorder0",
        "delegations": "recorder/delegations",
        "import": rules,
        "record": {"path": "recorded.mcap"},
    }
    (lab.folder / "recorder.yaml").write_text(yaml.safe_dump(config))
    proxy = lab.python("-m", "proxy.cli.proxy", "--config", "recorder.yaml", "--json")
    assert '"ready"' in lines_of(proxy, 1)[0]
    hostile = lab.python("-c", PUBLISHER, "robot", "/chatter")
    hostile.output()
    assert proxy.code is None, proxy.logged
    lab.output(sys.executable, "-c", PUBLISHER, "other", "/good")
    status = json.loads(lab.gdp("status", "recorder", "--json"))
    assert status["counters"]["faults"]["malformed"] == 2
    assert status["counters"]["faults"]["internal"] == 0
    said = proxy.finish()
    assert proxy.code == 0, proxy.logged
    topics = json.loads(said.splitlines()[-1])["topics"]
    assert {each["topic"]: each["received"] for each in topics} == {"/chatter": 1, "/good": 1}
    assert proxy.logged.count("/chatter: malformed") == 1
