"""List of frames and their expected fate, run through ``decide`` and through every data plane.

A case is a frame from the Ethernet header on, and the frames that leave. The planes run it on port 0 ("in"); ports 1
("wide") and 2 ("narrow") lead out. Port 3 does not exist: a port that is down looks like this to the table.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from gdp.errors import DropReason
from gdp.frame.codec import ETHERTYPE, Flag, Header, Kind, encode
from gdp.switch.table import NOWHERE, Hops, Table

IN, WIDE, NARROW, ABSENT = range(4)
MTUS = {IN: 1500, WIDE: 1500, NARROW: 700}
IN_MAC, WIDE_MAC, NARROW_MAC = (bytes([2, 0, 0, 0, port, 1]) for port in (IN, WIDE, NARROW))
PEER_MACS = {port: bytes([2, 0, 0, 0, port, 2]) for port in (IN, WIDE, NARROW)}

SOURCE, OTHER_SOURCE = bytes([0x50]) * 32, bytes([0x51]) * 32
ONE, BOTH, SPLIT, GONE, HALF, UNKNOWN, DEAD, ANYBODY = (bytes([0xD0 + n]) * 32 for n in range(8))
RESCUED, READY, CUT_OFF, TREE, PACED, SLOW = (bytes([0xE0 + n]) * 32 for n in range(6))
NO_SOURCE = bytes(32)
SECOND = 0x80
NO_SECOND = (DropReason.NO_SECOND_PATH,)

TO_WIDE = (WIDE, PEER_MACS[WIDE] + WIDE_MAC)
TO_NARROW = (NARROW, PEER_MACS[NARROW] + NARROW_MAC)
TO_ABSENT = (ABSENT, bytes(12))


def _second(name: bytes) -> bytes:
    return name[:31] + bytes([name[31] ^ 1])


ENTRIES: dict[bytes, Hops] = {
    _second(ONE) + SOURCE: (TO_NARROW,),
    _second(BOTH) + SOURCE: (TO_WIDE, TO_NARROW),
    _second(SPLIT): (TO_WIDE,),
    _second(GONE) + SOURCE: NOWHERE,
    ONE: (TO_WIDE,),
    BOTH: (TO_WIDE, TO_NARROW),
    SPLIT: (TO_WIDE,),
    SPLIT + OTHER_SOURCE: (TO_NARROW,),
    GONE: (TO_WIDE,),
    GONE + OTHER_SOURCE: NOWHERE,
    HALF: (TO_ABSENT, TO_WIDE),
    DEAD: (TO_ABSENT,),
    ANYBODY: (TO_WIDE,),
    ANYBODY + NO_SOURCE: (TO_NARROW,),
    RESCUED: ((*TO_ABSENT, *TO_NARROW),),
    READY: ((*TO_WIDE, *TO_NARROW),),
    CUT_OFF: ((*TO_ABSENT, *TO_ABSENT),),
    TREE: ((*TO_ABSENT, *TO_NARROW), (*TO_WIDE, *TO_ABSENT)),
    PACED + SOURCE: (TO_WIDE, TO_NARROW),
    SLOW + SOURCE: (TO_WIDE,),
}
PACES = {PACED + SOURCE: (200, 100), SLOW + SOURCE: (100,)}


def filled(entries: dict[bytes, Hops] = ENTRIES) -> Table:
    """Return a table with entries that stay."""
    table = Table()
    for key, hops in entries.items():
        table.install(key, hops, float("inf"), paces=PACES.get(key, ()))
    return table


@dataclass(frozen=True)
class Case:
    """Frame in, and its results: copies by port, drops by reason, or a punt."""

    name: str
    frame: bytes
    out: dict[int, bytes] = field(default_factory=dict)
    drops: tuple[DropReason, ...] = ()
    punted: bool = False


def frame(
    destination: bytes,
    payload: bytes = b"payload",
    *,
    source: bytes = SOURCE,
    kind: int = Kind.DATA,
    flags: int = Flag.LAST,
    hops_left: int = 64,
    length: int | None = None,
    padding: bytes = b"",
    pace: int = 0,
) -> bytes:
    """Return a frame as it comes in on port 0."""
    size = len(payload) if length is None else length
    numbers = 7, size, 0x0102030405060708, 3, 9, 0xAABBCCDDEEFF0011
    header = Header(kind, flags, hops_left, *numbers, destination, source, pace)
    ether = IN_MAC + PEER_MACS[IN] + ETHERTYPE.to_bytes(2, "big")
    return ether + encode(header) + payload + padding


def leaves(before: bytes, *ports: int) -> dict[int, bytes]:
    """Return the copies of a frame on these ports, written independently of the code under test."""
    macs = {WIDE: TO_WIDE[1], NARROW: TO_NARROW[1]}
    return {port: macs[port] + before[12:17] + bytes([before[17] - 1]) + before[18:] for port in ports}


def _changed(before: bytes, at: int, value: int) -> bytes:
    return before[:at] + bytes([value]) + before[at + 1 :]


def _forwarded(name: str, before: bytes, *ports: int, drops: tuple[DropReason, ...] = ()) -> Case:
    return Case(name, before, leaves(before, *ports), drops)


CASES = [
    _forwarded("unicast", frame(ONE), WIDE),
    _forwarded("an empty payload", frame(ONE, b""), WIDE),
    _forwarded("padding is kept", frame(ONE, b"x", padding=b"padding"), WIDE),
    _forwarded("unknown flags and kinds pass", frame(ONE, kind=0x7F, flags=0xFF), WIDE),
    _forwarded("two hops left become one", frame(ONE, hops_left=2), WIDE),
    _forwarded("127 hops left become 126", frame(ONE, hops_left=127), WIDE),
    _forwarded("a second copy takes the second path", frame(ONE, hops_left=SECOND | 64), NARROW),
    _forwarded("a second copy keeps its bit at the last hop", frame(ONE, hops_left=SECOND | 2), NARROW),
    _forwarded("a second copy with the most hops", frame(ONE, hops_left=SECOND | 127), NARROW),
    _forwarded("copies of a second copy", frame(BOTH, hops_left=SECOND | 64), NARROW, WIDE),
    _forwarded("a second copy of any source", frame(SPLIT, source=OTHER_SOURCE, hops_left=SECOND | 64), WIDE),
    Case("a second copy of another source", frame(ONE, source=OTHER_SOURCE, hops_left=SECOND | 64), drops=NO_SECOND),
    Case("a second copy without a second path", frame(HALF, hops_left=SECOND | 64), drops=NO_SECOND),
    Case("a second copy to an unknown name", frame(UNKNOWN, hops_left=SECOND | 64), drops=NO_SECOND),
    Case("a second copy with one hop left", frame(ONE, hops_left=SECOND | 1), drops=(DropReason.HOPS_EXPIRED,)),
    Case("a second copy with no hops left", frame(ONE, hops_left=SECOND), drops=(DropReason.HOPS_EXPIRED,)),
    Case("a negative entry of the second path", frame(GONE, hops_left=SECOND | 64), drops=(DropReason.NO_ROUTE,)),
    Case("a neighbour's word with the bit", frame(ONE, kind=Kind.HELLO, hops_left=SECOND | 1), punted=True),
    _forwarded("the widest frame", frame(ONE, bytes(1500 - 96)), WIDE),
    _forwarded("copies", frame(BOTH), WIDE, NARROW),
    _forwarded("the widest frame for both", frame(BOTH, bytes(700 - 96)), WIDE, NARROW),
    _forwarded("too big for one of two", frame(BOTH, bytes(701 - 96)), WIDE, drops=(DropReason.TOO_BIG,)),
    _forwarded("padding fills a link", frame(BOTH, bytes(600), padding=b"1234"), WIDE, NARROW),
    _forwarded("padding overfills it", frame(BOTH, bytes(600), padding=b"12345"), WIDE, drops=(DropReason.TOO_BIG,)),
    _forwarded("destination alone", frame(SPLIT), WIDE),
    _forwarded("source and destination come first", frame(SPLIT, source=OTHER_SOURCE), NARROW),
    _forwarded("one of two ports is down", frame(HALF), WIDE, drops=(DropReason.PORT_DOWN,)),
    Case("the only port is down", frame(DEAD), drops=(DropReason.PORT_DOWN,)),
    Case("a negative entry", frame(GONE, source=OTHER_SOURCE), drops=(DropReason.NO_ROUTE,)),
    _forwarded("a negative entry is of one source", frame(GONE), WIDE),
    _forwarded("no source", frame(ONE, source=NO_SOURCE), WIDE),
    _forwarded("an entry for no source", frame(ANYBODY, source=NO_SOURCE), NARROW),
    _forwarded("an entry for no source is for that alone", frame(ANYBODY), WIDE),
    _forwarded("urgent", frame(ONE, flags=Flag.LAST | Flag.URGENT), WIDE),
    _forwarded("an alternate while the port is down", frame(RESCUED), NARROW),
    _forwarded("no alternate while the port is up", frame(READY), WIDE),
    _forwarded("the alternate of a branch", frame(TREE), WIDE, NARROW),
    _forwarded("an alternate too narrow for a branch", frame(TREE, bytes(701 - 96)), WIDE, drops=(DropReason.TOO_BIG,)),
    _forwarded("a message for every branch", frame(PACED), WIDE, NARROW),
    _forwarded("a message at the pace of the slowest branch", frame(PACED, pace=100), WIDE, NARROW),
    _forwarded("a message for faster branches", frame(PACED, pace=101), WIDE, drops=(DropReason.THINNED,)),
    Case("a message for faster branches than here", frame(PACED, pace=255), drops=(DropReason.THINNED,) * 2),
    _forwarded("a pace without branches of its own", frame(ONE, pace=255), WIDE),
    _forwarded("a message at the pace of the only branch", frame(SLOW, pace=100), WIDE),
    Case("a message that is thinned before the only branch", frame(SLOW, pace=101), drops=(DropReason.THINNED,)),
    Case("an alternate that is too narrow", frame(RESCUED, bytes(701 - 96)), drops=(DropReason.TOO_BIG,)),
    Case("an alternate that is down too", frame(CUT_OFF), drops=(DropReason.PORT_DOWN,)),
    Case("an alternate goes round no more often", frame(RESCUED, hops_left=1), drops=(DropReason.HOPS_EXPIRED,)),
    Case("a miss", frame(UNKNOWN), punted=True),
    Case("a neighbour's word", frame(ONE, kind=Kind.HELLO), punted=True),
    Case("a neighbour's unknown word", frame(ONE, kind=0xFF, hops_left=0), punted=True),
    Case("a neighbour's word whose length is wrong", frame(ONE, kind=0x80, length=60_000), punted=True),
    Case("one hop left", frame(ONE, hops_left=1), drops=(DropReason.HOPS_EXPIRED,)),
    Case("no hops left", frame(ONE, hops_left=0), drops=(DropReason.HOPS_EXPIRED,)),
    Case("a miss with one hop left", frame(UNKNOWN, hops_left=1), drops=(DropReason.HOPS_EXPIRED,)),
    _forwarded("a diagnostic request", frame(ONE, kind=Kind.DIAGNOSTIC_REQUEST), WIDE),
    _forwarded("a diagnostic request to two", frame(BOTH, kind=Kind.DIAGNOSTIC_REQUEST, hops_left=2), WIDE, NARROW),
    Case("a diagnostic request ends here", frame(ONE, kind=Kind.DIAGNOSTIC_REQUEST, hops_left=1), punted=True),
    Case("a diagnostic request with no hops left", frame(ONE, kind=Kind.DIAGNOSTIC_REQUEST, hops_left=0), punted=True),
    Case(
        "the second copy of a diagnostic request",
        frame(ONE, kind=Kind.DIAGNOSTIC_REQUEST, hops_left=SECOND | 1),
        drops=(DropReason.HOPS_EXPIRED,),
    ),
    Case(
        "a diagnostic reply ends", frame(ONE, kind=Kind.DIAGNOSTIC_REPLY, hops_left=1), drops=(DropReason.HOPS_EXPIRED,)
    ),
    Case("a payload that is not there", frame(ONE, length=8), drops=(DropReason.TRUNCATED,)),
    Case("half a header", frame(ONE)[:61], drops=(DropReason.TRUNCATED,)),
    Case("one byte short of a header", frame(ONE, b"")[:-1], drops=(DropReason.TRUNCATED,)),
    Case("version 0", _changed(frame(ONE), 14, 0), drops=(DropReason.BAD_VERSION,)),
    Case("version 2", _changed(frame(ONE), 14, 2), drops=(DropReason.BAD_VERSION,)),
    Case("version 2 of a neighbour", _changed(frame(ONE, kind=Kind.HELLO), 14, 2), drops=(DropReason.BAD_VERSION,)),
]
