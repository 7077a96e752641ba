"""Holders of capsules that lie, withhold or roll back; a writer whose key has leaked; members that fill a disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gdp.capsule.audit import Audit, Damage
from gdp.capsule.chain import Chain, ChainWriter
from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.reading import CapsuleReader
from gdp.capsule.record import Record, RecordType
from gdp.capsule.upload import Uploader
from gdp.crypto.keys import SigningKey
from gdp.errors import GdpError, LocalError
from gdp.names import Name
from gdp.trust.right import Right
from tests.gdp.capsule.owned import NOW_S, descriptor, writer
from tests.gdp.stores.holder_sites import ABOUT, CHECKPOINTS, DATA, STARTS, WIRES, Site, forked

LAST = WIRES[CHECKPOINTS[-1]]


class Liar(Site):
    """A holder whose answers to reads are others than its disk has."""

    def __init__(self, folder: Path, data: bytes) -> None:
        super().__init__(folder, "liar")
        self.append(DATA, 0)
        self.given = data

    def answer(self, request: HolderRequest) -> HolderAnswer:
        answer = super().answer(request)
        if request.ask is not Ask.READ:
            return answer
        return replace(answer, offset=request.offset, data=self.given[request.offset :])


def flipped(number: int) -> bytes:
    """Return the records with a flipped bit in one, whose checksum is right again."""
    record = Record.from_wire(WIRES[number])
    body = bytes([record.body[0], record.body[1], record.body[2] ^ 1]) + record.body[3:]
    return b"".join([*WIRES[:number], record._replace(body=body).to_wire(), *WIRES[number + 1 :]])


def test_k01_what_a_holder_alters_is_named_to_a_reader_and_taken_by_no_other_holder(tmp_path: Path) -> None:
    liar, honest = Liar(tmp_path, flipped(40)), Site(tmp_path, "honest")
    reader = CapsuleReader(ABOUT, {})
    while not reader.is_done:
        list(reader.handle_response(liar.answer(reader.next_request())))
    assert {(each.damage, each.first) for each in reader.audit.findings} >= {(Damage.ALTERED, 40)}
    for _ in range(3):
        honest.fetch(liar)
    assert honest.data == DATA[: len(honest.data)]
    assert len(honest.data) <= STARTS[40]
    assert any("from liar" in each for each in honest.faults)


def test_k02_records_that_a_holder_invents_are_taken_by_no_other_holder(tmp_path: Path) -> None:
    chain = Chain(ABOUT.name, ABOUT.key)
    for wire in WIRES:
        chain.handle_record(wire)
    writes = ChainWriter(chain, SigningKey.generate())
    time_ns = chain.time_ns
    invented = [writes.append(RecordType.MESSAGE, time_ns, [b"invented"], 1, 1), writes.checkpoint(time_ns)]
    liar, honest = Liar(tmp_path, DATA + b"".join(invented)), Site(tmp_path, "honest")
    honest.fetch(liar)
    assert honest.data == DATA
    honest.append(DATA[-50:], len(DATA) - 50)


def test_k03_a_holder_that_withholds_is_named_and_any_other_one_has_the_rest(tmp_path: Path) -> None:
    liar, honest, third = Liar(tmp_path, DATA[: STARTS[30]]), Site(tmp_path, "honest"), Site(tmp_path, "third")
    honest.append(DATA, 0)
    for _ in range(4):
        third.fetch(liar)
    assert any("does not give what it says it has" in each for each in third.faults)
    third.fetch(honest)
    assert third.data == DATA
    audit = Audit(ABOUT.name, ABOUT.key, known=LAST)
    audit.add(liar.given)
    assert Damage.ROLLED_BACK in {each.damage for each in audit.finish()}


def test_k04_a_holder_that_rolls_back_is_named_to_the_writer_and_gets_the_rest_again() -> None:
    upload = Uploader(ABOUT.name, ABOUT)
    assert isinstance(upload.next_step(0, len(DATA), 1.0), HolderRequest)
    upload.handle_response(HolderAnswer(head=5_000, offset=5_000).to_cbor(), len(DATA), 1.0)
    upload.next_step(0, len(DATA), 2.0)
    upload.handle_response(HolderAnswer(head=900, offset=900).to_cbor(), len(DATA), 2.0)
    assert any("rolled back: 5000 bytes were confirmed, now it has 900" in each for each in upload.poll_faults())
    assert upload.confirmed == 900


@pytest.mark.parametrize("at", [1, 40, CHECKPOINTS[-1]])
def test_k05_a_thief_of_the_writers_key_rewrites_nothing_without_a_name(tmp_path: Path, at: int) -> None:
    """It signs another history: no holder takes it in place of what it has, and the exchange names the record."""
    one, two = Site(tmp_path, "one"), Site(tmp_path, "two")
    one.append(DATA, 0)
    thiefs = b"".join([*WIRES[:at], *forked(at, [b"of the thief"] * 3)])
    with pytest.raises(LocalError, match="fork"):
        one.append(thiefs, 0)
    assert one.data == DATA
    two.append(thiefs, 0)
    one.fetch(two)
    two.fetch(one)
    assert any(f"record {at} forked: its writer {writer().name.to_text()}" in each for each in one.faults + two.faults)
    audit = Audit(ABOUT.name, ABOUT.key, known=LAST)
    audit.add(thiefs)
    assert {each.damage for each in audit.finish()} & {Damage.FORKED, Damage.ROLLED_BACK}


def test_k06_a_member_without_the_owners_leave_takes_no_space(tmp_path: Path) -> None:
    site = Site(tmp_path, "site")
    for about in (descriptor("/other", Right.READ), replace(ABOUT, chain=()), replace(ABOUT, begun_ms=NOW_S)):
        request = HolderRequest(ask=Ask.APPEND, capsule=about.name, data=WIRES[0], descriptor=about)
        with pytest.raises(GdpError):
            site.store.handle(request.to_cbor(), Name(b"m" * 32))
    assert site.store.capsules == []
    assert [each.name for each in site.folder.iterdir() if each.is_dir()] == []
