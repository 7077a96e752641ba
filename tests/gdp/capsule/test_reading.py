"""Reading: what a holder gives in pieces comes out in order, and what is missing is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gdp.capsule.audit import Damage
from gdp.capsule.descriptor import Descriptor
from gdp.capsule.holder import HolderAnswer
from gdp.capsule.opening import Kept
from gdp.capsule.reading import CapsuleReader, Lost

FILE: dict[str, Any] = json.loads((Path(__file__).parents[2] / "vectors" / "capsule.json").read_text())
WIRES = [bytes.fromhex(each["wire"]) for each in FILE["records"]]
DESCRIPTOR = Descriptor.from_cbor(bytes.fromhex(FILE["descriptor"]["wire"]))
TOPIC = DESCRIPTOR.topic.name
SECRETS = {TOPIC: {FILE["epoch"]: bytes.fromhex(FILE["secret"])}}
MESSAGES = [bytes.fromhex(each["message"]) for each in FILE["opened"]]


def read(reader: CapsuleReader, data: bytes, piece: int = 100) -> list[Kept]:
    """Answer a reader's requests from these bytes."""
    kept = list[Kept]()
    while not reader.is_done:
        offset = reader.next_request().offset
        kept += reader.handle_response(HolderAnswer(head=len(data), offset=offset, data=data[offset : offset + piece]))
    return kept


@pytest.mark.parametrize("piece", [1, 100, 1_000, 10_000])
def test_messages_come_in_order_from_pieces_of_any_size(piece: int) -> None:
    reader = CapsuleReader(DESCRIPTOR, SECRETS)
    kept = read(reader, b"".join(WIRES), piece)
    assert [each.message for each in kept] == MESSAGES
    assert {each.description for each in kept} == {bytes.fromhex(FILE["description"])}
    assert (reader.audit.findings, reader.lost, reader.opener.closed) == ([], [], {})


def test_what_is_missing_or_damaged_is_named_and_the_rest_is_read() -> None:
    reader = CapsuleReader(DESCRIPTOR, SECRETS)
    kept = read(reader, b"".join([*WIRES[:3], *WIRES[4:]]))
    assert [each.message for each in kept] == [MESSAGES[0], MESSAGES[3]]
    assert reader.lost == [Lost(TOPIC, FILE["incarnation"], 2, 3)]
    assert [(each.damage, each.first) for each in reader.audit.findings] == [(Damage.REMOVED, 3)]
    flipped = bytearray(b"".join(WIRES))
    flipped[sum(map(len, WIRES[:3])) + 60] ^= 1
    reader = CapsuleReader(DESCRIPTOR, SECRETS)
    assert [each.message for each in read(reader, bytes(flipped))] == [MESSAGES[0], MESSAGES[3]]
    assert [(each.damage, each.first) for each in reader.audit.findings] == [(Damage.ALTERED, 3)]


def test_a_span_of_time_is_read_alone() -> None:
    times = [each["time_ns"] for each in FILE["records"]]
    reader = CapsuleReader(DESCRIPTOR, SECRETS, from_ns=times[3], to_ns=times[4])
    assert [each.message for each in read(reader, b"".join(WIRES))] == MESSAGES[1:3]


def test_without_the_epochs_secret_nothing_is_read() -> None:
    reader = CapsuleReader(DESCRIPTOR, {TOPIC: {}})
    assert read(reader, b"".join(WIRES)) == []
    assert sum(reader.opener.closed.values()) == 4
