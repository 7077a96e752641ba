"""Journal of a core: its inputs, the random values that it drew, and the frames that it sent in return.

Sans-I/O. A journal wraps the methods of one core through which inputs enter (``CALLS``). A core without a journal has
no wrapper, and costs nothing more. Entries are lists for CBOR, in the order in which things happened::

    [call, argument, ...]           a call of the core; arguments by name stand in a map at the end
    ["timer"]                       before a call: the core was asked for its next timer since the call before
    ["register", ask, foreign]      outside code answers diagnostic requests of this kind
    ["draw", bytes]                 within a call: random bytes that the core asked for
    ["sign", bytes]                 a signature by the node's key
    ["count", number]               frames that a data plane has counted at a port
    ["answer", result]              an answer of outside code
    ["raised", type]                the call before raised this exception
    ["send", mono_s]                the core was asked for frames, and had some:
    ["sent", port, mac, frame]      one of them

A block is entries of some 32 KiB, each after its length (4), compressed by zlib. When the ring is full, the oldest
block goes. A journal that has its first entry can be replayed.
"""

from __future__ import annotations

import base64
import functools
import struct
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from itertools import islice
from typing import Any, Final, TypeVar

from gdp.control.hello import NodeSettings, Timing
from gdp.control.rib_replication import Entry
from gdp.crypto.cbor import encode
from gdp.crypto.identity import Identity
from gdp.crypto.keys import PublicKey, SigningKey
from gdp.errors import LocalError
from gdp.names import Name
from gdp.rib.state import RibSettings
from gdp.sansio import KeepaliveRun, OutgoingFrames, ReceivedFrame, Timestamps
from gdp.trust.domain import Policy


def _moment(value: Any) -> Timestamps:
    return Timestamps(*map(float, value))


def _octets(value: Any) -> bytes:
    if not isinstance(value, bytes):
        raise TypeError("expected bytes")
    return value


def _arrivals(value: Any) -> list[ReceivedFrame]:
    return [ReceivedFrame(int(port), _octets(mac), _octets(frame), waited_s) for port, mac, frame, waited_s in value]


CALLS: Final[Mapping[str, tuple[Callable[[Any], Any], ...]]] = {  # each argument is read from CBOR so
    "add_port": (int, _octets, int, int, _moment),
    "port_changed": (int, bool, _moment),
    "receive": (_arrivals, _moment),
    "offload.frames_came": (float,),
    "offload.take_runs": (lambda value: [KeepaliveRun.from_fields(each) for each in value], float, _moment),
    "handle_timer": (_moment,),
    "revoke": (_octets, _moment),
    "query_name": (Name, float),
    "hello_protocol.set_timing": (int, lambda value: Timing(*value)),
    "hello_protocol.remove_port": (int,),
    "diagnostics.ask": (Name, str),
    "rib.load": (lambda value: [Entry.from_cbor(_octets(each)) for each in value], _moment),
}
LENGTH: Final = struct.Struct("!I")  # before each entry of a block
_BLOCK_BYTES: Final = 32 << 10  # before compression, which takes about a millisecond
_PAGE_BYTES: Final = 48 << 10  # the socket's buffer holds two more than that in base64
_Sign = Callable[[bytes], bytes]
_C = TypeVar("_C")
_R = TypeVar("_R")


class Journal:
    """Ring of the entries of one core, in compressed blocks.

    Args:
        max_bytes: of all blocks; more than one.
        unrepeatable: why it cannot be replayed; empty: it can.

    Attributes:
        first: number of the oldest entry that is kept; 0: none is lost.
    """

    def __init__(self, max_bytes: int, unrepeatable: str = "") -> None:
        self.first = 0
        self._blocks: deque[tuple[int, bytes]] = deque()  # entries, compressed
        self._lost_blocks = 0
        self._max_bytes, self._bytes = max_bytes, 0
        self._open: list[bytes] = []  # entries of the block that is being written
        self._open_bytes = 0
        self._is_within = False  # a call of the core: calls from within it follow from it
        self._was_asked = False  # for its next timer, since the last call
        self._start: dict[str, object] = {"unrepeatable": unrepeatable}
        self._core: Any = None

    def build(
        self,
        make: Callable[[Identity, Policy, NodeSettings], _C],
        identity: Identity,
        policy: Policy,
        settings: NodeSettings,
        begun: Timestamps,
        rib: RibSettings | None = None,
    ) -> _C:
        """Return a core whose calls, draws and signatures are recorded.

        Args:
            identity: gets a key that records what it signs.
            begun: the present time.
            rib: settings of a RIB.
        """
        self._start |= {
            "name": identity.name,
            "label": identity.label,
            "begun": list(begun),
            "member": identity.membership,
            "root": identity.root.to_pem(),
            "kem": identity.kem.public.wire,
            "roots": [root.to_pem() for root in policy.roots.values()],
            "transit": sorted(policy.transit),
            "diagnostics": sorted(policy.diagnostics),
            "revoked": [_plain(policy.revoked.kept(key)) for key in list(policy.revoked.keys())],
            "settings": _fields(settings),
            "rib": None if rib is None else _fields(rib),
        }
        key = identity.key
        identity.key = JournalKey(key.public, self._observed("sign", key.sign), self._observed("sign", key.sign_digest))
        settings = replace(settings, random_bytes=self._observed("draw", settings.random_bytes))
        core = make(identity, policy, settings)
        self._follow(core)
        return core

    def head(self, ports: Mapping[int, str] | None = None) -> dict[str, object]:
        """Return the head of an incident: what a replay starts from, and what the core dropped since.

        Args:
            ports: devices by port.
        """
        drops = {reason.label: count for reason, count in sorted(self._core.drops().items()) if count}
        named = {str(index): device for index, device in (ports or {}).items()}
        return {**self._start, "first": self.first, "drops": drops, "ports": named}

    def blocks(self) -> list[bytes]:
        """Return the blocks that are kept, the oldest first."""
        self._close_block()
        return [block for _, block in self._blocks]

    def page(self, arguments: Mapping[str, object], ports: Mapping[int, str]) -> dict[str, object]:
        """Return a page for a client of the control socket: JSON fields.

        Args:
            arguments: none for the first page; ``from`` and ``until`` for another: numbers of blocks.

        Raises:
            LocalError: blocks from there on are lost meanwhile, or an argument is wrong.
        """
        fields: dict[str, object] = {}
        if not arguments:
            fields["head"] = base64.b64encode(encode(self.head(ports))).decode()
            self._close_block()
        at = arguments.get("from", self._lost_blocks)
        until = arguments.get("until", self._lost_blocks + len(self._blocks))
        if not isinstance(at, int) or not isinstance(until, int):
            raise LocalError("from and until: expected numbers")
        if at < self._lost_blocks:
            raise LocalError("the journal was overwritten while it was read; give it more memory, or try again")
        page: list[str] = []
        for _, block in islice(self._blocks, at - self._lost_blocks, max(until - self._lost_blocks, 0)):
            page.append(base64.b64encode(block).decode())
            if sum(map(len, page)) > _PAGE_BYTES:
                break
        return {**fields, "blocks": page, "next": at + len(page), "until": until}

    def _follow(self, core: Any) -> None:
        """Record the calls and the frames of a core from now on; it has no port yet."""
        self._core = core
        for path in CALLS:
            *owners, name = path.split(".")
            owner = functools.reduce(lambda found, each: getattr(found, each, None), owners, core)
            if function := getattr(owner, name, None):
                setattr(owner, name, functools.partial(self._call, path, function))
        register, count_arrivals = core.diagnostics.register, core.count_arrivals

        def register_observed(ask: str, answer: Callable[..., object], *, for_foreign: bool = False) -> None:
            """Register an answer of outside code."""
            self._add(["register", ask, for_foreign])
            register(ask, self._observed("answer", answer), for_foreign=for_foreign)

        core.diagnostics.register = register_observed
        core.count_arrivals = lambda frames_from: count_arrivals(self._observed("count", frames_from))
        core.frames_to_send = functools.partial(self._send, core.frames_to_send)
        core.get_timer = functools.partial(self._timer, core.get_timer)

    def _observed(self, kind: str, function: Callable[..., _R]) -> Callable[..., _R]:
        """Return a function that records what ``function`` returns."""

        def observed(*arguments: object) -> _R:
            """Record one result."""
            result = function(*arguments)
            self._add([kind, result])
            return result

        return observed

    def _call(self, path: str, function: Callable[..., _R], *arguments: Any, **named: Any) -> _R:
        if self._is_within:
            return function(*arguments, **named)
        if self._was_asked:
            self._add(["timer"])
        if path in ("receive", "rib.load", "offload.take_runs"):
            arguments = (list(arguments[0]), *arguments[1:])
        self._add([path, *arguments, *([named] if named else [])])
        self._is_within, self._was_asked = True, False
        try:
            return function(*arguments, **named)
        except Exception as error:
            self._add(["raised", type(error).__name__])
            raise
        finally:
            self._is_within = False

    def _timer(self, get_timer: Callable[[], float | None]) -> float | None:
        self._was_asked = True
        return get_timer()

    def _send(self, frames_to_send: Callable[[float], list[OutgoingFrames]], now_s: float) -> list[OutgoingFrames]:
        transmits = frames_to_send(now_s)
        if transmits:
            self._add(["send", now_s])
        for port, mac, frames in transmits:
            for frame in frames:
                self._add(["sent", port, mac, frame])
        return transmits

    def _add(self, entry: list[Any]) -> None:
        wire = encode(_plain(entry))
        self._open += (LENGTH.pack(len(wire)), wire)
        self._open_bytes += len(wire)
        if self._open_bytes > _BLOCK_BYTES:
            self._close_block()

    def _close_block(self) -> None:
        """Compress the block that is being written; remove the oldest ones while there is no memory for it."""
        if self._open:
            block = zlib.compress(b"".join(self._open), 1)
            self._blocks.append((len(self._open) // 2, block))
            self._bytes += len(block)
            self._open, self._open_bytes = [], 0
        while self._bytes > self._max_bytes and len(self._blocks) > 1:
            entries, block = self._blocks.popleft()
            self.first += entries
            self._bytes -= len(block)
            self._lost_blocks += 1


class JournalKey(SigningKey):
    """Key of a node whose signatures go into a journal, or come from one: ECDSA draws a number for each."""

    def __init__(
        self, public: PublicKey, sign: Callable[[bytes], bytes], sign_digest: Callable[[bytes], bytes]
    ) -> None:
        self.public, self._sign, self._sign_digest = public, sign, sign_digest

    def sign(self, data: bytes) -> bytes:
        """Return r || s (64 bytes) over SHA-256 of ``data``."""
        return self._sign(data)

    def sign_digest(self, digest: bytes) -> bytes:
        """Return r || s (64 bytes) over a SHA-256 digest (32 bytes)."""
        return self._sign_digest(digest)

    def to_file(self, protect: Callable[[bytes], bytes] | None = None) -> bytes:
        """Raise ``LocalError``: a running node writes no key."""
        del protect
        raise LocalError("the key of a running node is not written")


def _fields(settings: NodeSettings | RibSettings) -> dict[str, object]:
    """Return settings by name, without the source of random bytes."""
    return {each.name: _plain(getattr(settings, each.name)) for each in fields(settings) if each.name != "random_bytes"}


def _plain(value: Any) -> Any:
    """Return a value as CBOR can write it; functions are left out."""
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items() if not callable(each)}
    return value.to_cbor() if isinstance(value, Entry) else value
