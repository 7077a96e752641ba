"""Exchange between holders: each fetches what another one has and it lacks, so that all become equal.

I/O, by its store; requests are yielded, and answers sent in. Records are taken up to a checkpoint, so each is proven by
its writer, whatever the other holder says. Where both have signed records of one number that differ, the writer forked.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import suppress
from itertools import accumulate
from typing import TypeAlias

from gdp.capsule.chain import Chain
from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.record import Record, RecordType, split
from gdp.errors import DropReason, GdpError, RemoteError, StoreError
from gdp.names import Name
from gdp.stores.capsule_store import CapsuleStore, StoredCapsule

Steps: TypeAlias = Generator[HolderRequest, HolderAnswer, None]


def run(steps: Steps, ask: Callable[[HolderRequest], HolderAnswer]) -> None:
    """Take all steps with answers of ``ask``."""
    with suppress(StopIteration):
        request = next(steps)
        while True:
            request = steps.send(ask(request))


def equalise(store: CapsuleStore, holder: str, doubted: set[Name]) -> Steps:
    """Fetch what another holder has and this one lacks.

    Args:
        holder: word for it in faults.
        doubted: capsules of which it gave less than it said, the last time.

    Raises:
        StoreError: the disk refuses.
    """
    total, lines = store.lines()
    is_equal = (yield HolderRequest(ask=Ask.SYNC, data=total)).data == total
    found = () if is_equal else (yield HolderRequest(ask=Ask.SYNC, data=lines)).descriptors
    doubted.intersection_update([each.name for each in found])
    for descriptor in found:
        is_adopted = False
        try:
            capsule = store.adopt(descriptor)
            is_adopted = True
            if capsule.damage or (yield from _fetch(store, capsule, holder)):
                doubted.discard(capsule.name)
            elif capsule.name in doubted:
                raise RemoteError(DropReason.MALFORMED, "it does not give what it says it has")
            else:
                doubted.add(capsule.name)
        except GdpError as error:
            store.note(descriptor.name, f"not fetched from {holder}: {error}")
            if is_adopted and isinstance(error, StoreError):
                raise


def _fetch(store: CapsuleStore, capsule: StoredCapsule, holder: str) -> Generator[HolderRequest, HolderAnswer, bool]:
    """Fetch one capsule's records, from the last checkpoint that both have on; return whether anything came of it."""
    back, has_come = 0, False
    while True:
        known = store.checkpoints(capsule) or [0]
        at = known[min(back, len(known) - 1)]
        begin, data = yield from _proven(capsule, at)
        wires = list(split(data))
        placed = zip(accumulate(map(len, wires), initial=begin), wires, strict=False)
        other = next((each for each in placed if not capsule.segments.has(*each)), None)
        if data and other is None:
            if not store.add(capsule, begin, data):
                return has_come or store.checkpoints(capsule) not in ([], known)
            back, has_come = 0, True
        elif other is not None and (other[0] > begin or at == known[-1]):
            number, writer = Record.from_wire(other[1]).number, capsule.descriptor.writer.name
            store.suspend(capsule, f"record {number} forked: its writer {writer.to_text()} gave {holder} another one")
            return True
        elif at == known[-1]:
            raise RemoteError(DropReason.MALFORMED, "its records are not the writer's")
        else:
            back = 2 * back + 1


def repair(store: CapsuleStore, capsule: StoredCapsule, offset: int, holder: str) -> Steps:
    """Fetch what is damaged or missing of the segment that begins at an offset, and behind it; 0: of the beginning.

    Raises:
        GdpError: the disk refuses.
    """
    segments = capsule.segments
    end = next((each for each in segments.offsets if each > offset), segments.end)
    begin, data = yield from _proven(capsule, offset, end)
    is_there, cut = begin == offset or begin < segments.begin, end - begin
    if data and is_there and segments.has(end, data[cut:]) and store.replace(capsule, begin, data[:cut]):
        store.note(capsule.name, f"the segment at {begin} is repaired from {holder}")


def _proven(
    capsule: StoredCapsule, at: int, end: int | None = None
) -> Generator[HolderRequest, HolderAnswer, tuple[int, bytes]]:
    """Return records from an offset, or behind a gap, to the next checkpoint; none: they are not proven.

    Args:
        end: to the last checkpoint up to this offset, instead.
    """
    chain, data, parsed = Chain(capsule.name, capsule.descriptor.key), b"", 0
    begin, proven, checkpoints = at, 0, 0
    while checkpoints < 2 if end is None else begin + parsed <= end:
        answer = yield HolderRequest(ask=Ask.READ, capsule=capsule.name, offset=begin + len(data))
        if not answer.data:
            break
        if data and answer.offset != begin + len(data):
            if end is not None or checkpoints > 1:
                break
            chain, data, parsed = Chain(capsule.name, capsule.descriptor.key), b"", 0  # it continues behind the gap
            proven, checkpoints = 0, 0
        begin, data = answer.offset - len(data), data + answer.data
        try:
            for wire in split(data, parsed):
                record = chain.handle_record(wire, may_skip=not parsed)
                parsed += len(wire)
                if record.type is RecordType.CHECKPOINT:
                    proven, checkpoints = parsed, checkpoints + 1
        except RemoteError:
            break
    return begin, data[:proven]
