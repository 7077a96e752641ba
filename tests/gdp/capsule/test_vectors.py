"""The published capsule: another implementation reads the same from the same bytes."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from gdp.capsule.audit import Audit
from gdp.capsule.chain import Chain
from gdp.capsule.checkpoint import Checkpoint
from gdp.capsule.descriptor import Descriptor
from gdp.capsule.opening import CapsuleOpener
from gdp.capsule.record import Record, RecordType, leaf_of
from gdp.errors import StatementError
from gdp.names import Name

FILE: dict[str, Any] = json.loads((Path(__file__).parents[2] / "vectors" / "capsule.json").read_text())
WIRES = [bytes.fromhex(each["wire"]) for each in FILE["records"]]
DESCRIPTOR = Descriptor.from_cbor(bytes.fromhex(FILE["descriptor"]["wire"]))


def test_the_name_digests_topic_writer_and_beginning() -> None:
    DESCRIPTOR.check_right(DESCRIPTOR.begun_ms / 1e3)
    assert DESCRIPTOR.name.hex() == FILE["descriptor"]["name"]
    assert DESCRIPTOR.key.compressed.hex() == FILE["descriptor"]["writer_key"]
    assert DESCRIPTOR.to_cbor().hex() == FILE["descriptor"]["wire"]


def test_a_name_of_several_topics_digests_their_names() -> None:
    several = FILE["several"]
    descriptor = Descriptor.from_cbor(bytes.fromhex(several["wire"]))
    assert (descriptor.name.hex(), descriptor.to_cbor().hex()) == (several["name"], several["wire"])
    assert [each.hex() for each in descriptor.topics] == several["topics"]
    assert dict(descriptor.metadata) == several["metadata"]
    assert several["metadata"]["topics"] == hashlib.sha256(b"".join(map(bytes.fromhex, several["topics"]))).hexdigest()
    with pytest.raises(StatementError):
        descriptor.check_right(descriptor.begun_ms / 1e3)


def test_records_leaves_heads_and_roots_are_as_published() -> None:
    chain = Chain(DESCRIPTOR.name, DESCRIPTOR.key)
    for wire, each in zip(WIRES, FILE["records"], strict=True):
        record = chain.handle_record(wire)
        fields = record.type.name.lower(), record.number, record.time_ns, record.sequence, record.messages
        assert fields == tuple(each[key] for key in ("type", "number", "time_ns", "sequence", "messages"))
        assert (leaf_of(wire).hex(), chain.head.hex()) == (each["leaf"], each["head_after"])
        if record.type is RecordType.CHECKPOINT:
            checkpoint = Checkpoint.from_record(record)
            assert (checkpoint.first, checkpoint.root.hex()) == (each["covers_from"], each["root"])
    audit = Audit(DESCRIPTOR.name, DESCRIPTOR.key, is_deep=True)
    audit.add(b"".join(WIRES))
    assert audit.finish() == []


def test_the_epochs_secret_opens_it_and_another_epochs_opens_nothing() -> None:
    for epoch, opens in ((FILE["epoch"], True), (FILE["epoch"] + 1, False)):
        topic, secrets = DESCRIPTOR.topic.name, {epoch: bytes.fromhex(FILE["secret"])}
        opener = CapsuleOpener(DESCRIPTOR, {topic: secrets})
        kept = [each for wire in WIRES for each in opener.open(Record.from_wire(wire))]
        assert [{"sequence": each.sequence, "message": each.message.hex()} for each in kept] == FILE["opened"] * opens
        assert opener.descriptions.get(topic, b"").hex() == FILE["description"] * opens
        assert opener.closed == ({} if opens else {FILE["epoch"]: 4})
        assert {each.incarnation for each in kept} <= {FILE["incarnation"]}
    assert DESCRIPTOR.writer.name == Name.from_text(FILE["descriptor"]["writer"])
