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

When the ring is full, the oldest entries go. A journal that has its first entry can be replayed.
"""

from __future__ import annotations

import base64
import functools
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from itertools import islice
from typing import Any, Final, TypeVar

from gdp.control.hello import Timing
from gdp.control.rib_replication import Entry
from gdp.control.settings import NodeSettings
from gdp.crypto.cbor import encode
from gdp.crypto.identity import Identity
from gdp.crypto.keys import SigningKey
from gdp.errors import LocalError
from gdp.names import Name
from gdp.rib.state import RibSettings
from gdp.sansio import OutgoingFrames, ReceivedFrame, Timestamps
from gdp.trust.domain import Policy

__all__ = ["CALLS", "Journal"]


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
    "handle_timer": (_moment,),
    "revoke": (_octets, _moment),
    "query_name": (Name, float),
    "hello_protocol.set_timing": (int, lambda value: Timing(*value)),
    "hello_protocol.remove_port": (int,),
    "diagnostics.ask": (Name, str),
    "rib.load": (lambda value: [Entry.from_cbor(_octets(each)) for each in value], _moment),
}
_ENTRY_BYTES: Final = 300  # of an entry in memory, without its frames
_PAGE_BYTES: Final = 64 << 10  # the socket's buffer holds a page in base64, which is sent in one piece
_C = TypeVar("_C")
_R = TypeVar("_R")


class Journal:
    """Ring of the entries of one core.

    Args:
        max_bytes: of all entries in memory, about.
        unrepeatable: why it cannot be replayed; empty: it can.

    Attributes:
        entries: those that are kept, the oldest first, with the bytes of each.
        first: number of the oldest; 0: none is lost.
    """

    def __init__(self, max_bytes: int, unrepeatable: str = "") -> None:
        self.entries: deque[tuple[list[Any], int]] = deque()
        self.first = 0
        self._max_bytes, self._bytes = max_bytes, 0
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
        identity.key = _ObservedKey(identity.key, self._observed)
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

    def wires(self, first: int = 0) -> Iterator[bytes]:
        """Yield the entries that are kept, from a number on, encoded."""
        for entry, _ in islice(self.entries, max(first - self.first, 0), None):
            yield encode(_plain(entry))

    def page(self, arguments: Mapping[str, object], ports: Mapping[int, str]) -> dict[str, object]:
        """Return a page for a client of the control socket: JSON fields.

        Args:
            arguments: ``from``: number of an entry, or nothing: the oldest; ``until``: of the first that is not wanted.

        Raises:
            LocalError: entries from there on are lost meanwhile, or an argument is wrong.
        """
        end = self.first + len(self.entries)
        at, until = arguments.get("from", self.first), arguments.get("until", end)
        if not isinstance(at, int) or not isinstance(until, int):
            raise LocalError("from and until: expected numbers")
        if at < self.first:
            raise LocalError("the journal was overwritten while it was read; give it more memory, or try again")
        page: list[str] = []
        size = 0
        for wire in islice(self.wires(at), max(min(until, end) - at, 0)):
            page.append(base64.b64encode(wire).decode())
            size += len(wire)
            if size > _PAGE_BYTES:
                break
        head = {} if "from" in arguments else {"head": base64.b64encode(encode(self.head(ports))).decode()}
        return {**head, "entries": page, "next": at + len(page), "until": until}

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
        size = 0
        if path == "receive":
            size = sum([_ENTRY_BYTES + len(each.frame) for each in arguments[0]])
        elif path == "rib.load":
            arguments = (list(arguments[0]), *arguments[1:])
        self._add([path, *arguments, *([named] if named else [])], size)
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
        self._add(["send", now_s])
        transmits = frames_to_send(now_s)
        if not transmits and self.entries and self.entries[-1][0][0] == "send":
            self._bytes -= self.entries.pop()[1]  # most steps of a node send nothing
        for port, mac, frames in transmits:
            for frame in frames:
                self._add(["sent", port, mac, frame], len(frame))
        return transmits

    def _add(self, entry: list[Any], size: int = 0) -> None:
        size += _ENTRY_BYTES
        self.entries.append((entry, size))
        self._bytes += size
        while self._bytes > self._max_bytes:
            self._bytes -= self.entries.popleft()[1]
            self.first += 1


class _ObservedKey(SigningKey):
    """A node's key whose signatures are recorded: ECDSA draws a number for each."""

    def __init__(self, key: SigningKey, observed: Callable[[str, Callable[..., bytes]], Callable[..., bytes]]) -> None:
        self.public = key.public
        self._sign, self._sign_digest = observed("sign", key.sign), observed("sign", key.sign_digest)
        self._to_file = key.to_file

    def sign(self, data: bytes) -> bytes:
        """Return r || s (64 bytes) over SHA-256 of ``data``."""
        return self._sign(data)

    def sign_digest(self, digest: bytes) -> bytes:
        """Return r || s (64 bytes) over a SHA-256 digest (32 bytes)."""
        return self._sign_digest(digest)

    def to_file(self, protect: Callable[[bytes], bytes] | None = None) -> bytes:
        """Return the content of this key's private file, in PEM."""
        return self._to_file(protect)


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
