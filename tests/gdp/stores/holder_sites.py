"""Holders without a network: stores that ask each other, with one history or two that the writer signed."""

from __future__ import annotations

from pathlib import Path

from gdp.capsule.chain import Chain, ChainWriter
from gdp.capsule.descriptor import Descriptor
from gdp.capsule.holder import Ask, HolderAnswer, HolderRequest
from gdp.capsule.record import Record, RecordType
from gdp.intervals import HOUR_S
from gdp.names import Name
from gdp.stores.capsule_store import CapsuleStore, StoreLimits
from gdp.stores.holder_exchange import equalise, run
from gdp.stores.holder_upkeep import HolderUpkeep
from tests.gdp.capsule.log import Log
from tests.gdp.capsule.owned import NOW_S, descriptor, writer

ABOUT = descriptor()
WIRES = Log(writer().key, ABOUT.name).add(120).closed().wires
DATA = b"".join(WIRES)
STARTS = [sum(map(len, WIRES[:at])) for at in range(len(WIRES))]
CHECKPOINTS = [at for at, wire in enumerate(WIRES) if Record.from_wire(wire).type is RecordType.CHECKPOINT]
FILE_BYTES = 3_000
LIMITS = StoreLimits(owner_bytes=1 << 24, spare_bytes=0)


class Site:
    """A holder's store, and what it asks of others."""

    def __init__(self, folder: Path, label: str, limits: StoreLimits = LIMITS) -> None:
        self.label, self.folder, self.limits = label, folder / label, limits
        self.answered: list[HolderRequest] = []
        self.open()

    def open(self) -> None:
        self.store = CapsuleStore(self.folder, self.limits, lambda: NOW_S)
        self.faults: list[str] = []
        self.doubted: set[Name] = set()

    def append(self, data: bytes, offset: int, about: Descriptor = ABOUT) -> None:
        request = HolderRequest(ask=Ask.APPEND, capsule=about.name, offset=offset, data=data, descriptor=about)
        self.store.handle(request.to_cbor(), writer().name)

    def answer(self, request: HolderRequest) -> HolderAnswer:
        self.answered.append(request)
        return HolderAnswer.from_cbor(self.store.handle(request.to_cbor(), Name(b"h" * 32)))

    def fetch(self, other: Site) -> None:
        run(equalise(self.store, other.label, self.doubted), other.answer)
        self.faults += self.store.poll_faults().values()

    def upkeep(self, *others: Site) -> None:
        """Work until everything was read again."""
        of = {each.label: each for each in others}
        keep = HolderUpkeep(self.store, list(of), 0.0)
        for second in range(40):
            now_s = second * HOUR_S / 20
            for label, steps in keep.handle_timer(now_s):
                run(steps, of[label].answer)
                keep.ended(label, now_s)
        self.faults += self.store.poll_faults().values()

    @property
    def data(self) -> bytes:
        pieces, at = list[bytes](), 0
        while answer := self.answer(HolderRequest(ask=Ask.READ, capsule=ABOUT.name, offset=at)).data:
            pieces.append(answer)
            at += len(answer)
        return b"".join(pieces)


def forked(count: int, frames: list[bytes]) -> list[bytes]:
    """Return other records behind the first ones, with a checkpoint over each message."""
    writes = ChainWriter(Chain(ABOUT.name, ABOUT.key), writer().key)
    for wire in WIRES[:count]:
        writes.chain.handle_record(wire)
    time_ns, wires = writes.chain.time_ns, list[bytes]()
    for frame in frames:
        wires += [writes.append(RecordType.MESSAGE, time_ns, [frame], 1, 1), writes.checkpoint(time_ns)]
    return wires
