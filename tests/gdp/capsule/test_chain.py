"""Chain and Merkle tree: only the writer's records extend a capsule, and each proves its place."""

from __future__ import annotations

import hashlib
from collections import deque

import pytest

from gdp.capsule.chain import Chain
from gdp.capsule.checkpoint import Checkpoint, proof_of, proven_root, root_of
from gdp.capsule.record import Record, RecordType, leaf_of
from gdp.errors import RemoteError
from gdp.names import ZERO
from tests.gdp.capsule.log import NAME, Log
from tests.gdp.message.sealed import OTHER, WRITER


def test_the_records_of_a_writer_extend_the_chain() -> None:
    log, chain = Log().add(25).closed(), Chain(NAME, WRITER.public)
    for wire in log.wires:
        chain.handle_record(wire)
    assert (chain.head, chain.number) == (log.writer.chain.head, len(log.wires))


@pytest.mark.parametrize("size", [1, 2, 3, 7, 8, 13])
def test_each_record_proves_its_place_in_the_tree(size: int) -> None:
    leaves = [hashlib.sha256(bytes([at])).digest() for at in range(size)]
    for index, leaf in enumerate(leaves):
        proof = proof_of(leaves, index)
        assert proven_root(leaf, index, size, proof) == root_of(leaves)
        assert all(proven_root(other, index, size, proof) != root_of(leaves) for other in leaves if other != leaf)
        with pytest.raises(RemoteError):
            proven_root(leaf, index, size, [*proof, leaf])


def test_the_tree_is_that_of_certificate_transparency() -> None:
    hashed = [leaf_of(each) for each in (b"", b"\0", b"\x10")]  # RFC 9162 gives no vectors; those of its reference code
    assert hashed[0].hex() == "6e340b9cffb37a989ca544e6bb780a2c78901d3fb33738768511a30617afa01d"
    assert root_of(hashed).hex() == "aeb6bcfe274b70a14fb067a5e5578264db0fa9b51af5e0ba159158f329e06e77"


@pytest.mark.parametrize("at", [0, 1, 5, -1])
def test_a_missing_record_ends_the_chain(at: int) -> None:
    wires, chain = Log().add(25).closed().wires, Chain(NAME, WRITER.public)
    del wires[at if at >= 0 else len(wires) - 2]
    with pytest.raises(RemoteError):
        deque(map(chain.handle_record, wires))


def test_another_writer_cannot_extend_it() -> None:
    chain, foreign = Chain(NAME, WRITER.public), Log(OTHER).add(3).closed()
    with pytest.raises(RemoteError):
        chain.handle_record(foreign.wires[0])


def test_a_checkpoint_over_other_records_is_a_fork() -> None:
    one, two = Log().add(3), Log().add(3)  # the salts of their seals differ
    chain = Chain(NAME, WRITER.public)
    for wire in one.wires:
        chain.handle_record(wire)
    with pytest.raises(RemoteError, match="fork"):
        chain.handle_record(two.closed().wires[-1])


def test_the_chain_goes_on_from_a_later_checkpoint() -> None:
    log = Log().add(25).closed()
    later = [Record.from_wire(wire).type for wire in log.wires].index(RecordType.CHECKPOINT, 1)
    chain = Chain(NAME, WRITER.public)
    with pytest.raises(RemoteError):
        chain.handle_record(log.wires[later])
    chain.handle_record(log.wires[later], may_skip=True)
    for wire in log.wires[later + 1 :]:
        chain.handle_record(wire)
    assert chain.head == log.writer.chain.head


def test_a_checkpoint_belongs_to_one_capsule_and_one_place() -> None:
    record = Record.from_wire(Log().add(3).closed().wires[-1])
    checkpoint = Checkpoint.from_record(record)
    checkpoint.verify(NAME, record, WRITER.public)
    for name, other in ((ZERO, record), (NAME, record._replace(number=9)), (NAME, record._replace(time_ns=9))):
        with pytest.raises(RemoteError):
            checkpoint.verify(name, other, WRITER.public)
